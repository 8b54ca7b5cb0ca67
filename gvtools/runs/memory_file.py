"""The memory in a file or in a run's folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError, ProjectError
from gvtools.memory.files import INDEX
from gvtools.runs.digests import check_sums
from gvtools.runs.layout import APPEARANCE, MEMORY, POINTS, RECORD, round_folder, saved_memory

if TYPE_CHECKING:
    from gvtools.appearance.appearance import Appearance
    from gvtools.memory.spatial_memory import SpatialMemory


def load_appearance(path: Path) -> Appearance | None:
    """The Gaussians that a run fitted; None for a file, and for a run without them."""
    from gvtools.appearance.appearance import Appearance

    file = round_folder(path, 0) / APPEARANCE
    return Appearance.load(file) if file.exists() else None


def load_memory(path: Path, *, up_to: int | None = None) -> SpatialMemory:
    """The memory in a file or of a run.

    Args:
        path: a memory file, a folder of tiles, a coloured PLY, or a run's folder; an unfinished run
            gives that of its last complete round.
        up_to: forget the rounds after this one; None keeps all.
    """
    from gvtools.memory.spatial_memory import SpatialMemory, TiledMemory

    memory: SpatialMemory
    if path.suffix.lower() == ".ply":
        # Sums beside a PLY of somebody else's are none of a run.
        if path.name == POINTS and (path.parent / RECORD).is_file():
            check_sums(path.parent, (path.name,))
        memory = SpatialMemory.from_ply(path)
    else:
        saved = memory_path(path)
        memory = TiledMemory.load(saved) if saved.is_dir() else SpatialMemory.load(saved)
    if up_to is not None:
        if up_to not in memory.rounds:
            raise OptionError(
                f"--round {up_to}: the memory has rounds {', '.join(map(str, memory.rounds))}; "
                "expected one of them"
            )
        for number in reversed(memory.rounds):
            if number > up_to:
                memory.forget(round=number)
    return memory


def memory_path(path: Path) -> Path:
    """The memory that ``path``, a file, a folder of tiles or a run's folder, stands for."""
    if path.is_file() or (path / INDEX).is_file():
        return path
    if not path.is_dir():
        raise ProjectError(f"{path}: no such file or folder; expected a memory or a run's folder")
    rounds = sorted(path.glob("round_*"))
    for candidate in map(saved_memory, (path, *reversed(rounds))):
        if candidate.exists():
            return candidate
    raise ProjectError(
        f"{path}: holds no {MEMORY} and no round with one; expected a run's folder or a memory file"
    )
