"""Files newer than this program, and of suffixes that nothing opens, are named as such."""

from __future__ import annotations

import struct
import zipfile

import pytest
from command_line import refused

NEWER = {
    "a.spz": b"NGSP" + struct.pack("<II4B", 5, 10, 3, 12, 0, 0) + bytes(99),
    "a.glb": b"glTF" + struct.pack("<II", 3, 99) + bytes(99),
    "a.las": b"LASF" + bytes(20) + bytes([1, 5]) + bytes(400),
}


@pytest.mark.parametrize("name", NEWER)
def test_newer_files_are_named_as_such(tmp_path, capsys, name):
    (tmp_path / name).write_bytes(NEWER[name])
    said = refused(capsys, "view", tmp_path / name, "--screenshot", tmp_path / "a.png")
    assert "version" in said and "newer than this program" in said


def test_a_newer_memory_asks_for_a_newer_program(tmp_path, capsys):
    with zipfile.ZipFile(tmp_path / "memory.npz", "w") as archive:
        archive.writestr("header.json", '{"format": "gvtools memory", "version": 99}')
    said = refused(capsys, "view", tmp_path / "memory.npz", "--screenshot", tmp_path / "a.png")
    assert "99" in said and "update gvtools" in said


@pytest.mark.parametrize(
    ("words", "opened"),
    [
        (("view", "{}", "--screenshot", "{}.png"), ".npz, .ply"),
        (("export", "{}", "--format", "ply", "--out", "{}.ply"), ".npz, .ply"),
        (("check", "{}"), "transforms.json"),
        (("reconstruct", "{}", "--out", "{}.out"), "transforms.json"),
    ],
)
def test_unknown_suffixes_list_what_opens(tmp_path, capsys, words, opened):
    file = tmp_path / "a.rar"
    file.write_bytes(b"PK\x03\x04" + bytes(99))
    assert opened in refused(capsys, *(word.format(file) for word in words))
    assert list(tmp_path.iterdir()) == [file]
