"""The files of a rendered view: NAME.rgb.png, NAME.depth.npz, NAME.valid.png, NAME.confidence.png.

A confidence c is drawn as the grey level 255 c / (1 + c): 1 is mid grey, and every c has its own
side of it. ``depth.npz`` holds the key ``depth``, float32, scene units, 0 = none.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from gvtools.files import replaced_when_written
from gvtools.guidance import Guidance


def write_view(folder: Path, stem: PurePosixPath, guidance: Guidance) -> None:
    """Write the four files of one view.

    Args:
        folder: made when absent, sub-folders of ``stem`` too.
        stem: what the files' names start with.
        guidance: a batch of one.
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
        np.savez_compressed(file, depth=guidance.depth[0].astype(np.float32))


def _write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    from PIL import Image

    with replaced_when_written(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG", compress_level=3)
