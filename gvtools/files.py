"""Writing files so that a crash or a full disk leaves the earlier version whole."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from gvtools.errors import GvError, ProjectError

# Members of a zip carry a time stamp; this one keeps equal content equal files.
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
# Bytes free on a full disk at most.
ALMOST_NONE = 1 << 16


@contextmanager
def replaced_when_written(path: Path, *, suffix: str = "", flush: bool = True) -> Iterator[Path]:
    """Gives a temporary name beside ``path``; on success it is flushed and takes that name.

    Devices, pipes and the like (``/dev/stdout``) stay what they are: they get the bytes instead.

    Args:
        suffix: that the temporary name ends with, for writers that tell the format by it.
        flush: False leaves it to the system when the bytes reach the disk, for files that need not
            outlast the process.
    """
    stream = _is_stream(path)
    folder = Path(tempfile.mkdtemp()) if stream else path.parent
    temporary = folder / f".{path.name}.part{suffix}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield temporary
        if stream:
            with temporary.open("rb") as source, path.open("ab") as target:
                shutil.copyfileobj(source, target)
            return
        if flush:
            flush_file(temporary)
        temporary.replace(path)
    except Exception as error:
        # Libraries have errors of their own for a full disk.
        reason = "" if isinstance(error, GvError) else full_disk(folder)
        # Whoever reads what is printed meanwhile may have gone.
        if isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
            reason = error.strerror or reason or str(error)
        if not reason:
            raise
        # A writer's own temporary name says nothing to the user.
        name = path.parent / re.sub(r"^\.(.+)\.part(\.\w+)*$", r"\1", path.name)
        raise ProjectError(
            f"{name}: cannot be written ({reason}); free some space or choose another folder; what "
            "was there before is intact"
        ) from error
    finally:
        # Where even this fails, the first error is the one to tell.
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if stream:
            shutil.rmtree(folder, ignore_errors=True)


def full_disk(folder: Path) -> str:
    """What the system says of a full disk, where the folder's is one; else ""."""
    full = folder.is_dir() and shutil.disk_usage(folder).free < ALMOST_NONE
    return os.strerror(errno.ENOSPC) if full else ""


def _is_stream(path: Path) -> bool:
    """Whether a path is a device or a pipe, or what a process has open (``/dev/stdout``)."""
    whole = path.parent.resolve() / path.name
    opened = [str(whole), os.readlink(whole) if whole.is_symlink() else ""]
    special = whole.exists() and not (whole.is_file() or whole.is_dir())
    return special or any(name.startswith("/proc/") for name in opened)


def flush_file(path: Path) -> None:
    """Wait until the bytes of a file are on the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


@contextmanager
def folder_replaced_when_written(path: Path) -> Iterator[Path]:
    """Gives an empty folder of the same name; on success it takes the place of ``path``, if any.

    What only the earlier folder holds moves over into the new one. A kill leaves one of both
    complete; ``recover_folder`` finds it.
    """
    new, old = _work(path) / "new" / path.name, _work(path) / "old"
    try:
        _settle(path)
        new.mkdir(parents=True)
        yield new
        if path.exists():
            os.rename(path, old)
        os.rename(new, path)
    except (OSError, ProjectError) as error:
        cause = error.__cause__ if isinstance(error, ProjectError) else error
        if not isinstance(cause, OSError):
            raise
        raise ProjectError(
            f"{path}: cannot be replaced ({cause.strerror or cause}); free some space and try "
            "again; it is as it was"
        ) from cause
    finally:
        _settle(path)


def recover_folder(path: Path) -> None:
    """Put a folder back that a killed ``folder_replaced_when_written`` had moved aside."""
    old = _work(path) / "old"
    if old.is_dir() and not path.exists():
        os.rename(old, path)


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there; of a folder, a kill leaves all or nothing."""
    if not path.is_dir():
        path.unlink(missing_ok=True)
        return
    aside = _work(path)
    shutil.rmtree(aside, ignore_errors=True)
    os.rename(path, aside)
    shutil.rmtree(aside)


def only_in(old: Path, new: Path) -> list[str]:
    """Names of what one folder holds and another does not, without files that were half-written."""
    names = {entry.name for entry in old.iterdir() if not entry.name.endswith(".part")}
    return sorted(names - {entry.name for entry in new.iterdir()})


def _work(path: Path) -> Path:
    """Where the folder that is to replace ``path`` is written, on the same file system."""
    return path.with_name(f".{path.name}.part")


def _settle(path: Path) -> None:
    """End a replacement wherever it stopped."""
    recover_folder(path)
    old = _work(path) / "old"
    if old.is_dir():
        for name in only_in(old, path):
            os.rename(old / name, path / name)
    shutil.rmtree(_work(path), ignore_errors=True)


def link_or_copy(source: Path, target: Path) -> None:
    """The same file under another name, or a copy of it on another disk.

    A hard link: both names are ordinary files that survive copying to another machine. To write
    *into* one of them changes the other; to replace it does not.
    """
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)


def check_space(path: Path, needed: int) -> None:
    """Refuse to write so many bytes below ``path`` where fewer are free."""
    place = path
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if free < needed:
        raise ProjectError(
            f"{path}: {needed / 1e9:.1f} GB are needed, {free / 1e9:.1f} GB are free; free some "
            "space or choose another folder"
        )


def check_parent(path: Path) -> None:
    """Before a long computation: whether its result can be written to ``path`` in the end."""
    if not path.parent.is_dir():
        raise ProjectError(f"{path}: no folder {path.parent}; make it first")


def make_folder(path: Path) -> None:
    """Make a folder for results, where there is none yet."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProjectError(
            f"{path}: cannot be made a folder ({error.strerror or error}); choose another"
        ) from error


@contextmanager
def folder_for_results(path: Path) -> Iterator[None]:
    """A folder that is made before the work; a failure that leaves a new one empty removes it."""
    new = not path.exists()
    make_folder(path)
    try:
        yield
    except BaseException:
        if new:
            with suppress(OSError):
                path.rmdir()
        raise


def write_text(path: Path, text: str) -> None:
    """Write a whole text file (UTF-8) under its final name only when it is complete.

    Names of files that are no text stand in it with backslashes.
    """
    with replaced_when_written(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


class JsonList:
    """A list within a JSON object that is written item by item, so that memory does not grow."""

    def __init__(self, file: TextIO) -> None:
        self._file, self._count = file, 0

    def add(self, item: Mapping[str, Any]) -> None:
        """Append; NaN and infinity become null."""
        self._file.write((",\n" if self._count else "\n") + json.dumps(_finite(item)))
        self._count += 1


@contextmanager
def json_list_written(path: Path, head: Mapping[str, Any], name: str) -> Iterator[JsonList]:
    """Gives a list to append to; on success ``path`` holds ``head`` with it as ``name``."""
    with replaced_when_written(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(json.dumps({**_finite(head), name: []})[: -len("]}")])
        yield JsonList(file)
        file.write("\n]}\n")


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """One JSON object; NaN and infinity become null."""
    write_text(path, json.dumps(_finite(data), indent=1) + "\n")


def digest(content: object) -> str:
    """16 hex digits of SHA-256 over a text, or over plain data as JSON."""
    text = content if isinstance(content, str) else json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not (abs(value) < float("inf")):
        return None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value
