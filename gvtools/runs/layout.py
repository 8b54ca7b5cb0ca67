"""Where the files of a run lie, and how they are named.

    run.json  rounds.jsonl  memory.npz  metrics.json
    round_000/report.json  round_000/context_depth_VIEW.npz
    round_001/report.json  round_001/{guidance,valid,generated,after,depth}_TARGET.*

Other modules of this package read and write these files; nothing outside knows their names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import count
from pathlib import Path, PurePosixPath

from gvtools.errors import OptionError, ProjectError

RECORD, REPORT, ROUNDS, METRICS = "run.json", "report.json", "rounds.jsonl", "metrics.json"
MEMORY = "memory.npz"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm")
# Pictures that a round leaves of each target.
GUIDANCE, VALID, COMPLETION, AFTER = "guidance", "valid", "generated", "after"


def round_folder(run: Path, number: int) -> Path:
    """The folder of round ``number`` of a run."""
    return run / f"round_{number:03d}"


def target_picture(folder: Path, kind: str, stem: str) -> Path:
    """The picture of a target in a round's folder: GUIDANCE, VALID, COMPLETION or AFTER."""
    return folder / f"{kind}_{stem}.png"


def target_depth(folder: Path, stem: str) -> Path:
    """The depth maps of a target in a round's folder."""
    return folder / f"depth_{stem}.npz"


def context_depth(folder: Path, stem: str) -> Path:
    """The computed depth of a context view in the folder of round 0."""
    return folder / f"context_depth_{stem}.npz"


def inside(folder: Path, path: Path) -> Path:
    """``path``, if it lies in ``folder`` once every link and ".." is followed.

    Raises:
        ProjectError: it does not.
    """
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ProjectError(f"{path}: lies outside {folder}; only a run's own files are read")
    return path


def file_stems(names: Sequence[str]) -> dict[str, PurePosixPath]:
    """For each view name the path that its files start with, below the output folder.

    An image suffix is left out, unless two views then had the same files; where whole names differ
    in case alone, or in how they write one path, all but one get a number. No two stems are the
    same for a file system that ignores case, and their order in ``names`` plays no part.

    Raises:
        OptionError: a name that leads out of the folder.
    """
    whole, stems = {}, {}
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts or not path.name:
            raise OptionError(f"view {name!r}: leads out of the output folder; rename the view")
        whole[name] = path
        stems[name] = path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path
    # A whole name may be what another one is without its suffix, so look again after each change.
    while shared := [name for name in _ambiguous(stems) if stems[name] != whole[name]]:
        stems |= {name: whole[name] for name in shared}
    used = {str(path).lower() for path in stems.values()}
    seen: set[str] = set()
    for name in sorted(_ambiguous(stems)):
        path = stems[name]
        if str(path).lower() in seen:
            numbered = (path.with_name(f"{path.name}_{number}") for number in count(2))
            stems[name] = next(path for path in numbered if str(path).lower() not in used)
            used.add(str(stems[name]).lower())
        seen.add(str(path).lower())
    return stems


def _ambiguous(stems: dict[str, PurePosixPath]) -> list[str]:
    """The names that share their stem with another. File systems may ignore case."""
    number = Counter(str(path).lower() for path in stems.values())
    return [name for name, path in stems.items() if number[str(path).lower()] > 1]


def target_stems(names: Sequence[str]) -> tuple[str, ...]:
    """For each target a distinct part of file names: without folders, and mostly without ending."""
    stems = [str(stem).replace("/", "__") for stem in file_stems(names).values()]
    number_of = Counter(stem.lower() for stem in stems)
    used = {stem for stem, number in number_of.items() if number == 1}
    out = []
    for i, stem in enumerate(stems):
        candidate, number = stem, i
        while number_of[stem.lower()] > 1 and (candidate == stem or candidate.lower() in used):
            candidate, number = f"{stem}_{number:04d}", number + len(stems)
        used.add(candidate.lower())
        out.append(candidate)
    return tuple(out)
