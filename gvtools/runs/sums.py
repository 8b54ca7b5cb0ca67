"""Checksums of the files of a run and of its rounds: ``SHA256SUMS``, as ``sha256sum -c`` takes it.

Pictures, PLY and JSON do not tell by themselves that a bit of them was flipped. The memory has
checksums of its own, and moves on to the next round. A folder without the file is taken as it is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from gvtools.errors import ProjectError
from gvtools.files import write_text
from gvtools.runs.layout import MEMORY, RECORD
from gvtools.untrusted import named_file, read_text, regular

SUMS = "SHA256SUMS"


def write_sums(folder: Path, names: Iterable[str] | None = None) -> None:
    """Write the sums of files of a folder.

    Args:
        folder: of a run or of a round.
        names: of the files; None: all but the memory.
    """
    if names is None:
        there = (path.name for path in folder.iterdir() if path.is_file())
        names = (name for name in there if name not in (MEMORY, SUMS))
    lines = [f"{_sum(folder / name)}  {name}\n" for name in sorted(names)]
    write_text(folder / SUMS, "".join(lines))


def check_sums(folder: Path, names: Iterable[str] | None = None) -> None:
    """Refuse files that are not as they were written.

    Args:
        folder: of a run or of a round.
        names: of the files; None: all that have a sum.
    """
    path = folder / SUMS
    if not path.is_file():
        return
    try:
        lines = read_text(path).splitlines()
        sums = {name: total for total, name in (line.split("  ", 1) for line in lines)}
    except (OSError, ValueError) as error:
        raise _damaged(path, str(error)) from None
    for name in sums if names is None else names:
        if name not in sums:
            continue
        file = named_file(folder, name, where=str(path))
        try:
            whole = sums[name] == _sum(file)
        except OSError as error:
            raise _damaged(folder / name, error.strerror or str(error)) from None
        if not whole:
            raise _damaged(folder / name, "its bytes are not those that were written")


def _damaged(path: Path, why: str) -> ProjectError:
    folder = path.parent
    # A run writes anew what is made of its rounds.
    anew = "" if (folder / RECORD).is_file() else f"remove {folder} and "
    return ProjectError(
        f"{path}: damaged ({why}); restore it, or {anew}run reconstruct again with --resume (if "
        f"it was edited on purpose, remove {folder / SUMS})"
    )


def _sum(path: Path) -> str:
    total = hashlib.sha256()
    with regular(path).open("rb") as file:
        while part := file.read(1 << 20):
            total.update(part)
    return total.hexdigest()
