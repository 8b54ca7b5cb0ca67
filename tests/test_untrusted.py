from __future__ import annotations

import io
import os
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from gvtools.errors import GvError, ProjectError, printable
from gvtools.scenes.scene import Finding
from gvtools.untrusted import (
    is_file,
    load_array,
    load_arrays,
    named_file,
    open_picture,
    parse_json,
    parse_yaml,
    read_text,
)


def test_arrays_come_back_as_numpy_reads_them(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "a": rng.normal(size=(3, 4)),
        "b": np.asfortranarray(rng.integers(0, 9, (5, 2), np.int16)),
        "c": np.array("text"),
        "d": np.zeros((0, 3), np.float32),
        "e": np.array(7),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "x.npz", **arrays)  # type: ignore[arg-type]
        with np.load(tmp_path / "x.npz", allow_pickle=False) as expected:
            found = load_arrays(tmp_path / "x.npz")
            assert sorted(found) == sorted(expected)
            for name in expected:
                np.testing.assert_array_equal(found[name], expected[name])
                assert found[name].dtype == expected[name].dtype
    assert list(load_arrays(tmp_path / "x.npz", "b")) == ["b"]
    with pytest.raises(KeyError, match="'z' among a, b"):
        load_arrays(tmp_path / "x.npz", "z")
    np.save(tmp_path / "y.npy", arrays["b"])
    np.testing.assert_array_equal(load_array(tmp_path / "y.npy"), arrays["b"])


def test_an_array_of_objects_is_not_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    np.save(tmp_path / "x.npy", np.array([Evil()], object), allow_pickle=True)
    np.savez(tmp_path / "x.npz", a=np.array([Evil()], object))
    with pytest.raises(ValueError, match="type object"):
        load_array(tmp_path / "x.npy")
    with pytest.raises(ValueError, match="type object"):
        load_arrays(tmp_path / "x.npz")
    assert not (tmp_path / "made").exists()


def test_a_shape_that_the_bytes_cannot_hold_takes_no_memory(tmp_path):
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    )
    (tmp_path / "x.npy").write_bytes(head.getvalue() + bytes(64))
    with pytest.raises(ValueError, match=r"10000000000000.* in \d+ bytes"):
        load_array(tmp_path / "x.npy")


@pytest.mark.parametrize("kind", ["fifo", "folder", "zero", "absent"])
def test_what_is_no_file_is_not_waited_for(tmp_path, kind):
    path = tmp_path / "x"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "zero":
        path.symlink_to("/dev/zero")
    with pytest.raises(OSError):
        read_text(path)
    with pytest.raises(OSError):
        open_picture(path)
    assert not is_file(path)


@pytest.mark.filterwarnings("ignore:Image size")
def test_a_picture_may_not_claim_more_pixels_than_it_can_hold(tmp_path):
    Image.new("RGB", (3000, 2000)).save(tmp_path / "blank.png")
    assert open_picture(tmp_path / "blank.png").size == (3000, 2000)
    data = bytearray((tmp_path / "blank.png").read_bytes())
    data[16:24] = (13_000).to_bytes(4, "big") * 2
    import zlib

    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    (tmp_path / "bomb.png").write_bytes(data)
    with pytest.raises(ValueError, match="13000x13000 pixels in"):
        open_picture(tmp_path / "bomb.png")
    with pytest.raises(ValueError, match="13000x13000"):
        open_picture(bytes(data))


@pytest.mark.parametrize(
    "name", ["../x", "/etc/passwd", "a/../../x", "link", "link/x", "folder/../link", "..", "a\0b"]
)
def test_a_name_that_leads_out_is_refused(tmp_path, name):
    home = tmp_path / "home"
    (home / "folder").mkdir(parents=True)
    (tmp_path / "other").mkdir()
    (home / "link").symlink_to(tmp_path / "other")
    with pytest.raises(ProjectError, match=r"^list\.txt: names the file"):
        named_file(home, name, where="list.txt")


def test_a_name_that_stays_inside_passes(tmp_path):
    home = tmp_path / "home"
    (home / "folder").mkdir(parents=True)
    (home / "inner").symlink_to(home / "folder")
    (tmp_path / "alias").symlink_to(home)
    for folder in (home, tmp_path / "alias"):
        for name in ("x", "folder/x", "folder/../x", "inner/x", str(folder / "x"), "x/./y"):
            assert named_file(folder, name, where="") == folder / name
    # A download may lie elsewhere and be linked.
    (home / "linked.bin").symlink_to(tmp_path / "elsewhere.bin")
    assert named_file(home, "linked.bin", where="", follow_links=True) == home / "linked.bin"
    with pytest.raises(ProjectError):
        named_file(home, "../linked.bin", where="", follow_links=True)


def test_json_and_yaml_bombs_are_refused(tmp_path):
    for text in ("[" * 100_000, '{"a":' * 100_000, "[" * 100_000 + "]" * 100_000, "9" * 10_000):
        with pytest.raises(ValueError):
            parse_json(text)
    assert parse_json('{"a": [1, 2.5, null]}') == {"a": [1, 2.5, None]}
    made = tmp_path / "made"
    for text in (
        "\n".join(f"{b}: &{b} [{','.join([f'*{a}'] * 30)}]" for a, b in pairwise("_abcde")).replace(
            "*_", "x"
        ),
        f"a: !!python/object/apply:os.mkdir ['{made}']",
        "[" * 5000,
        "- " * 5000,
        "a: [1",
        "\t- x",
        "a: &a [*a]",
        "2001-99-99",
    ):
        with pytest.raises(ValueError) as met:
            parse_yaml(text)
        assert "\n" not in str(met.value)
    assert not made.exists()


def test_an_error_is_one_printable_line():
    error = ProjectError("a\x1b[31m\nb\u202ec\ud800 naïve 深")
    assert str(error) == r"a\x1b[31m\nb\u202ec\ud800 naïve 深"
    assert isinstance(error, GvError)
    long = str(ProjectError("x" * 10**6 + "; do that"))
    assert len(long) < 2100
    assert long.endswith("; do that")
    assert Finding("info", "a\nb").message == r"a\nb"
    assert printable("plain text") == "plain text"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le-marked"])
def test_text_of_windows_programs_reads_as_any_other(tmp_path, encoding):
    text = "1.5 rgb/ä.png\r\n2.5 rgb/b.png\r3\n"
    data = b"\xff\xfe" + text.encode("utf-16-le") if "marked" in encoding else text.encode(encoding)
    (tmp_path / "list.txt").write_bytes(data)
    assert read_text(tmp_path / "list.txt") == "1.5 rgb/ä.png\n2.5 rgb/b.png\n3\n"
