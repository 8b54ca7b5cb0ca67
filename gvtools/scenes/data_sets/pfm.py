"""Depth maps in the portable float map format (PFM), whose rows run from the bottom up."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.photographs import Depth
from gvtools.untrusted import regular


def read_pfm_depth(path: Path, *, unit: float = 1.0) -> Depth:
    """A grey PFM file as (H, W) float32 depth, 0 where it is not a positive number.

    Args:
        path: the file.
        unit: scene units in a stored unit.
    """
    try:
        with regular(path).open("rb") as file:
            kind = file.readline().split()
            width, height = (int(word) for word in file.readline().split())
            scale = float(file.readline())
            dtype = np.dtype("<f4" if scale < 0 else ">f4")
            if kind != [b"Pf"]:
                raise ValueError(f"it begins with {kind}, not with Pf")
            values = np.frombuffer(file.read(width * height * 4), dtype).reshape(height, width)
    except (OSError, ValueError) as error:
        raise ProjectError(f"{path}: no grey PFM ({error}); copy or export it again") from None
    depth = values[::-1].astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
