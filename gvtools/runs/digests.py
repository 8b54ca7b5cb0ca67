"""Digests of files and arrays: what decides a run's result, and ``SHA256SUMS`` of what it wrote.

Pictures, PLY and JSON do not tell by themselves that a bit of them was flipped. The memory has
checksums of its own, and moves on to the next round. A folder without ``SHA256SUMS``, which is as
``sha256sum -c`` takes it, is taken as it is.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

import gvtools
from gvtools.errors import ProjectError
from gvtools.files import write_text
from gvtools.runs.layout import MEMORY, RECORD
from gvtools.untrusted import named_file, read_text, sha256_of

SUMS = "SHA256SUMS"
# Of a large file, so many bytes at either end tell it from others.
END_BYTES = 2**22


def _sha256(parts: Iterable[bytes]) -> str:
    """SHA-256 of bytes one after the other."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part)
    return total.hexdigest()


def fingerprint(files: Iterable[Path]) -> str:
    """A digest of the names, sizes and modification times of files that a run reads."""
    lines = []
    for path in sorted(set(files)):
        try:
            status = path.stat()
        except OSError:
            lines.append(f"{path.name}:absent\n")
            continue
        lines.append(f"{path.name}:{status.st_size}:{status.st_mtime_ns}\n")
    return _sha256(line.encode() for line in lines)


def array_digest(arrays: Iterable[NDArray[Any] | None]) -> str:
    """A digest of the bytes of arrays, in order; None stands for an absent array."""
    return _sha256(b"none" if array is None else array.tobytes() for array in arrays)


def folder_digest(folder: Path, *, without: str) -> str:
    """16 digits over each file's relative path, size and both ends, but for one folder in it."""

    def parts() -> Iterator[bytes]:
        for path in sorted(folder.rglob("*")):
            if not path.is_file() or folder / without in path.parents:
                continue
            size = path.stat().st_size
            yield f"{path.relative_to(folder).as_posix()} {size} ".encode()
            with path.open("rb") as file:
                yield file.read(END_BYTES)
                file.seek(max(0, size - END_BYTES))
                yield file.read(END_BYTES)

    return _sha256(parts())[:16]


@cache
def versions() -> dict[str, str]:
    """Versions of what a run's bytes depend on."""
    out = {"gvtools": gvtools.__version__, "python": platform.python_version()}
    for name in ("numpy", "numba", "open3d", "pycolmap", "torch", "scipy"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "absent"
    return out


def write_sums(folder: Path, names: Iterable[str] | None = None) -> None:
    """Write the sums of files of a run's or a round's folder; None: of all but the memory."""
    if names is None:
        there = (path.name for path in folder.iterdir() if path.is_file())
        names = (name for name in there if name not in (MEMORY, SUMS))
    lines = [f"{sha256_of(folder / name)}  {name}\n" for name in sorted(names)]
    write_text(folder / SUMS, "".join(lines))


def check_sums(folder: Path, names: Iterable[str] | None = None) -> None:
    """Refuse files that are not as they were written; None: any that has a sum."""
    path = folder / SUMS
    if not path.is_file():
        return
    try:
        lines = read_text(path).splitlines()
        sums = {name: total for total, name in (line.split("  ", 1) for line in lines)}
    except (OSError, ValueError) as error:
        raise _damage(path, str(error)) from None
    for name in sums if names is None else names:
        if name not in sums:
            continue
        file = named_file(folder, name, where=str(path))
        try:
            whole = sums[name] == sha256_of(file)
        except OSError as error:
            raise _damage(folder / name, error.strerror or str(error)) from None
        if not whole:
            raise _damage(folder / name, "its bytes are not those that were written")


def _damage(path: Path, why: str) -> ProjectError:
    folder = path.parent
    # A run writes anew what is made of its rounds.
    anew = "" if (folder / RECORD).is_file() else f"remove {folder} and "
    return ProjectError(
        f"{path}: damaged ({why}); restore it, or {anew}run reconstruct again with --resume (if "
        f"it was edited on purpose, remove {folder / SUMS})"
    )
