"""The files of a rendered view: NAME.rgb.png, NAME.depth.npz, NAME.valid.png, NAME.confidence.png.

A confidence c is drawn as the grey level 255 c / (1 + c): 1 is mid grey, and every c has its own
side of it. ``depth.npz`` holds the key ``depth``, float32, scene units, 0 = none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import count
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.files import replaced_when_written
from gvtools.guidance import Guidance
from gvtools.runs.arrays import save_arrays

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm")


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
    while shared := [name for name in _alike(stems) if stems[name] != whole[name]]:
        stems |= {name: whole[name] for name in shared}
    taken = {str(path).lower() for path in stems.values()}
    seen: set[str] = set()
    for name in sorted(_alike(stems)):
        path = stems[name]
        if str(path).lower() in seen:
            numbered = (path.with_name(f"{path.name}_{number}") for number in count(2))
            stems[name] = next(path for path in numbered if str(path).lower() not in taken)
            taken.add(str(stems[name]).lower())
        seen.add(str(path).lower())
    return stems


def _alike(stems: dict[str, PurePosixPath]) -> list[str]:
    """The names whose stems are not theirs alone. File systems may ignore case."""
    number = Counter(str(path).lower() for path in stems.values())
    return [name for name, path in stems.items() if number[str(path).lower()] > 1]


def write_view(folder: Path, stem: PurePosixPath, guidance: Guidance) -> None:
    """Write the four files of one view.

    Args:
        folder: made when absent, sub-folders of ``stem`` too.
        stem: what the files' names start with.
        guidance: a batch of one.

    Raises:
        ProjectError: a file cannot be written.
    """
    confidence = guidance.confidence[0].astype(np.float64)
    grey = np.round(255 * confidence / (1 + confidence)).astype(np.uint8)
    rgb = np.round(np.clip(guidance.rgb[0], 0, 1) * 255).astype(np.uint8)
    base = folder / stem
    _write_png(base.with_name(f"{base.name}.rgb.png"), rgb)
    _write_png(base.with_name(f"{base.name}.valid.png"), guidance.valid[0].astype(np.uint8) * 255)
    _write_png(base.with_name(f"{base.name}.confidence.png"), grey)
    path = base.with_name(f"{base.name}.depth.npz")
    with replaced_when_written(path) as temporary, temporary.open("wb") as file:
        save_arrays(file, depth=guidance.depth[0].astype(np.float32))


def _write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    from PIL import Image

    with replaced_when_written(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG", compress_level=3)
