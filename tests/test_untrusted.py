from __future__ import annotations

import io
import os
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gvtools import files
from gvtools.errors import GvError, MemoryFileError, ProjectError, printable
from gvtools.files import (
    folder_replaced_when_written,
    recover_folder,
    replaced_when_written,
    write_text,
)
from gvtools.sandbox import Item, ReaderError, read_apart
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


def test_an_array_of_objects_is_not_unpickled_and_one_of_lies_not_made(tmp_path):
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
    # Nor is memory taken for a shape that the bytes cannot hold.
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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "run"
    (path / "round_000").mkdir(parents=True)
    (path / "round_000" / "memory").write_text("old")
    (path / "notes.txt").write_text("mine")
    (path / ".half.part").write_text("x")
    return path


def contents(path: Path) -> dict[str, str]:
    return {str(p.relative_to(path)): p.read_text() for p in path.rglob("*") if p.is_file()}


def replace_it(path: Path) -> None:
    with folder_replaced_when_written(path) as new:
        assert new.name == path.name
        (new / "round_000").mkdir()
        (new / "round_000" / "memory").write_text("new")


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, OSError(28, "No space left")])
def test_an_error_leaves_the_earlier_folder(folder, error):
    before = contents(folder)
    expected = ProjectError if isinstance(error, OSError) else error
    with pytest.raises(expected), folder_replaced_when_written(folder) as new:
        (new / "half").write_text("x")
        raise error
    assert contents(folder) == before
    assert os.listdir(folder.parent) == ["run"]


@pytest.mark.parametrize("moment", range(3))
def test_a_kill_at_any_rename_leaves_one_of_both_whole(folder, monkeypatch, moment):
    class Killed(BaseException):
        """Nothing runs after it, as after a kill."""

    before, rename, calls = contents(folder), os.rename, []

    def killed(*names):
        calls.append(names)
        if len(calls) > moment:
            raise Killed
        rename(*names)

    monkeypatch.setattr(files.os, "rename", killed)
    with pytest.raises(Killed):
        replace_it(folder)
    monkeypatch.undo()
    recover_folder(folder)
    found = contents(folder)
    assert found in (before, {"round_000/memory": "new"})
    assert (found == before) == (moment < 2)
    # The next replacement ends what was begun; the user's files move over, half-written ones not.
    replace_it(folder)
    assert contents(folder) == {"round_000/memory": "new", "notes.txt": "mine"}
    assert os.listdir(folder.parent) == ["run"]


def test_pipes_and_open_files_get_the_bytes_and_stay_what_they_are(tmp_path):
    pipe, file = tmp_path / "pipe", tmp_path / "file"
    os.mkfifo(pipe)
    with file.open("w") as opened, ThreadPoolExecutor(1) as pool:
        read = pool.submit(pipe.read_text)
        write_text(pipe, "a")
        write_text(Path(f"/proc/self/fd/{opened.fileno()}"), "b")
        assert (read.result(timeout=20), file.read_text()) == ("a", "b")
    assert pipe.is_fifo() and sorted(tmp_path.iterdir()) == [file, pipe]
    with pytest.raises(ProjectError, match="No space left"):
        write_text(Path("/dev/full"), "c")
    assert Path("/dev/full").is_char_device()


def test_an_error_of_a_library_on_a_full_disk_is_told_as_that(tmp_path, monkeypatch):
    def write() -> None:
        with (
            replaced_when_written(tmp_path / "a.las") as outer,
            replaced_when_written(outer) as inner,
        ):
            inner.write_text("half")
            raise RuntimeError("IoError")

    with pytest.raises(RuntimeError):
        write()
    # A reader of the output that goes is no error of the file.
    with pytest.raises(BrokenPipeError), replaced_when_written(tmp_path / "a") as temporary:
        temporary.write_bytes(b"begun")
        raise BrokenPipeError
    monkeypatch.setattr(files, "ALMOST_NONE", 1 << 62)
    with pytest.raises(ProjectError, match=r"/a\.las: cannot be written \(No space left"):
        write()
    assert list(tmp_path.iterdir()) == []


def reader(path: Path, *, how: str) -> Iterator[Item]:
    yield {}, {}
    for number in range(2):
        yield {"number": number}, {"values": np.arange(number + 1)}
    if how == "memory":
        np.ones(1 << 28)
    elif how == "crash":
        os.abort()
    elif how == "word":
        raise MemoryFileError(f"{path}: no such points")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "a.bin").write_bytes(b"123")
    return tmp_path / "a.bin"


@pytest.mark.parametrize(
    ("how", "error", "said"),
    [("whole", StopIteration, "^$"), ("memory", ReaderError, "status"),
     ("crash", ReaderError, "status"), ("word", MemoryFileError, "no such points")],
)  # fmt: skip
def test_items_pass_in_their_order_and_what_stops_them_is_one_error(path, how, error, said):
    items = read_apart(f"{__name__}:reader", path, how=how)
    passed = [(facts["number"], arrays["values"].tolist()) for facts, arrays in islice(items, 2)]
    assert passed == [(0, [0]), (1, [0, 1])]
    with pytest.raises(error, match=said):
        next(items)
