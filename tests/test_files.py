from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from gvtools import files
from gvtools.errors import ProjectError
from gvtools.files import (
    folder_replaced_when_written,
    recover_folder,
    replaced_when_written,
    write_text,
)


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


def test_the_new_folder_takes_the_place_and_foreign_files_move_over(folder):
    replace_it(folder)
    assert contents(folder) == {"round_000/memory": "new", "notes.txt": "mine"}
    assert os.listdir(folder.parent) == ["run"]


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
    # The next replacement ends what was begun, and the user's file is there again.
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
    monkeypatch.setattr(files, "ALMOST_NONE", 1 << 62)
    with pytest.raises(ProjectError, match=r"/a\.las: cannot be written \(No space left"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_reader_of_the_output_that_goes_is_no_error_of_the_file(tmp_path):
    with pytest.raises(BrokenPipeError), replaced_when_written(tmp_path / "a") as temporary:
        temporary.write_bytes(b"begun")
        raise BrokenPipeError
    assert not list(tmp_path.iterdir())
