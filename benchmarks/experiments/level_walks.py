"""Walks through hand-made levels as posed RGB-D folders: pictures to train on.

    python -m benchmarks.experiments.level_walks --levels DIR --judged DIR --out DIR

``--levels`` may hold any packages with maps of Quake III's format, ``--judged`` those that models
are judged on. A map whose name begins like that of a judged one is left out: it may be another
version of it. The folders are of the 7-Scenes layout, which ``data.scenes`` of a training takes.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.experiments.level_cases import walk
from benchmarks.experiments.level_render import LevelScene
from benchmarks.experiments.level_textures import Pictures
from benchmarks.experiments.quake_levels import Archives, read_level
from gvtools.errors import GvError
from gvtools.scenes.calibration import INTRINSICS
from gvtools.training.samples import Clip

# Names of maps that begin with as many equal letters may be of one map's versions.
LIKE = 5
# Of 16 bits, in millimetres; 65535 stands for no reading.
FARTHEST = 65.0
WALKS, VIEWS, SIZE = 3, 16, 192


def unjudged(maps: tuple[str, ...], judged: tuple[str, ...]) -> list[str]:
    """Maps that are no version of a judged one.

    Args:
        maps: paths in the archives.
        judged: likewise.
    """
    taken = {Path(name).stem[:LIKE] for name in judged}
    return [name for name in maps if Path(name).stem[:LIKE] not in taken]


def write_walks(
    levels: Path,
    judged: Path,
    out: Path,
    *,
    walks: int = WALKS,
    views: int = VIEWS,
    size: int = SIZE,
    seed: int = 0,
    say: Callable[[str], None] = print,
) -> list[Path]:
    """Write the walks of every map that can be walked through, and return their folders.

    A walk that is there already is kept.

    Args:
        levels: folder with the archives to walk through.
        judged: folder with the archives whose maps are left out.
        out: folder of the walks' folders.
        walks: of a map.
        views: of a walk.
        size: of the square pictures, px.
        seed: of the walks.
        say: is told of each map.

    Raises:
        ProjectError: no archive with a map in a folder.
    """
    archives = Archives(levels)
    pictures = Pictures(archives)
    written: list[Path] = []
    for name in unjudged(archives.maps, Archives(judged).maps):
        stem = Path(name).stem
        try:
            level = read_level(archives.read(name), name)
            scene = LevelScene(level, pictures.of(level.materials))
        except (GvError, OSError) as error:
            say(f"{stem}: left out ({error})")
            continue
        here = len(written)
        for number in range(walks):
            folder = out / f"{stem}_{number}"
            if not folder.exists():
                rng = np.random.default_rng([seed, *stem.encode(), number])
                clip = walk(scene, rng, size=size, views=views)
                if clip is None:
                    break
                part = out / f".{folder.name}.part"
                shutil.rmtree(part, ignore_errors=True)
                part.mkdir(parents=True)
                write_clip(clip, part)
                part.rename(folder)
            written.append(folder)
        say(f"{stem}: {len(written) - here} walks")
    return written


def write_clip(clip: Clip, folder: Path) -> None:
    """A clip of one camera in the 7-Scenes layout.

    Args:
        clip: in metres; what is farther than ``FARTHEST`` has no depth.
        folder: exists.
    """
    # Published intrinsics count the first pixel's centre as (0, 0).
    K = clip.cameras.K[0] - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    np.savetxt(folder / INTRINSICS, K)
    for index in range(len(clip)):
        stem = folder / f"frame-{index:06d}"
        millimetres = np.where(clip.depth[index] <= FARTHEST, 1000 * clip.depth[index], 0)
        Image.fromarray(clip.rgb[index]).save(f"{stem}.color.png")
        Image.fromarray(np.rint(millimetres).astype(np.uint16)).save(f"{stem}.depth.png")
        np.savetxt(f"{stem}.pose.txt", clip.cameras.world_from_cam[index])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("levels", "judged", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True, metavar="DIR")
    parser.add_argument("--walks", type=int, default=WALKS, metavar="N", help="of a map")
    given = parser.parse_args()
    write_walks(given.levels, given.judged, given.out, walks=given.walks)
