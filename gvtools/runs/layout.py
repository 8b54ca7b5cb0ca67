"""Layout and names of the files of a run.

    run.json  rounds.jsonl  memory.npz (or memory.tiles/)  memory.ply  metrics.json  SHA256SUMS
    round_000/report.json  round_000/context_depth_VIEW.npz  round_000/appearance.npz
    round_000/poses.npz  tuned/{config.json,geoverse.safetensors,tuning.json}
    round_*/SHA256SUMS
    round_001/report.json  round_001/{guidance,valid,generated,after,depth}_TARGET.*
    round_001/panorama_PICTURE.png

Other modules of this package read and write these files; nothing outside knows their names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path, PurePosixPath

from gvtools.errors import OptionError, ProjectError

RECORD, REPORT, ROUNDS, METRICS = "run.json", "report.json", "rounds.jsonl", "metrics.json"
POINTS = "memory.ply"
MEMORY, APPEARANCE, POSES = "memory.npz", "appearance.npz", "poses.npz"
# The folder that a memory larger than its budget is saved as, in the place of MEMORY; and where its
# tiles are written meanwhile.
TILES, TILES_AT_WORK = "memory.tiles", ".tiles.part"
# Weights of the generative core that were tuned to the run's context.
TUNED = "tuned"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm")
# The picture of another lens that targets are the faces of.
PANORAMA = "panorama"
# Pictures that a round leaves of each target.
GUIDANCE, VALID, COMPLETION, AFTER = "guidance", "valid", "generated", "after"


def round_folder(run: Path, number: int) -> Path:
    """The folder of round ``number`` of a run."""
    return run / f"round_{number:03d}"


def target_picture(folder: Path, kind: str, stem: str) -> Path:
    """The picture of a target in a round's folder: GUIDANCE, VALID, COMPLETION, AFTER, PANORAMA."""
    return folder / f"{kind}_{stem}.png"


def target_depth(folder: Path, stem: str) -> Path:
    """The depth maps of a target in a round's folder."""
    return folder / f"depth_{stem}.npz"


def context_depth(folder: Path, stem: str) -> Path:
    """The computed depth of a context view in the folder of round 0."""
    return folder / f"context_depth_{stem}.npz"


def inside(folder: Path, path: Path) -> Path:
    """``path``, if it lies in ``folder`` once every link and ".." is resolved."""
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ProjectError(f"{path}: lies outside {folder}; only a run's own files are read")
    return path


def saved_memory(folder: Path) -> Path:
    """The memory in the folder of a run or of a round: its tiles, else its file, perhaps absent."""
    tiles = folder / TILES
    return tiles if tiles.is_dir() else folder / MEMORY


def file_stems(names: Sequence[str]) -> dict[str, PurePosixPath]:
    """For each view name the path that its files start with, below the output folder.

    An image suffix is left out, unless two views then had the same files; what is then still the
    same for a file system that ignores case gets a number.
    """
    whole, short = {}, {}
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts or not path.name:
            raise OptionError(f"view {name!r}: leads out of the output folder; rename the view")
        whole[name] = str(path)
        short[name] = str(path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path)
    number_of = Counter(stem.lower() for stem in short.values())
    stems = {name: stem if number_of[stem.lower()] == 1 else whole[name]
             for name, stem in short.items()}  # fmt: skip
    return {name: PurePosixPath(stem) for name, stem in _distinct(stems).items()}


def target_stems(names: Sequence[str]) -> tuple[str, ...]:
    """For each target a distinct part of file names: without folders, and mostly without ending."""
    stems = {name: str(stem).replace("/", "__") for name, stem in file_stems(names).items()}
    return tuple(_distinct(stems).values())


def _distinct(stems: Mapping[str, str]) -> dict[str, str]:
    """The stems, by name, with numbers behind those that another name has, in order of names."""
    used: set[str] = set()
    distinct = dict(stems)
    for name in sorted(stems):
        candidates = (
            f"{stems[name]}_{number}" if number > 1 else stems[name] for number in count(1)
        )
        distinct[name] = next(stem for stem in candidates if stem.lower() not in used)
        used.add(distinct[name].lower())
    return distinct
