"""Points of USD files, read in a child process: OpenUSD ends its process on some damaged ones."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.optional import require
from gvtools.sandbox import Item, ReaderError, read_apart

GREY = 160


def read_usd(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """(N, 3) positions and colours of all UsdGeom.Points, in the file's frame."""
    require("pxr", extra="export", purpose=f"{path}: {path.suffix}")
    try:
        parts = [arrays for _, arrays in read_apart(f"{__name__}:points", path)]
        positions, colors = (
            np.concatenate([part[name] for part in parts]) for name in ("positions", "colors")
        )
        return positions, colors
    except (ReaderError, OSError, ValueError, KeyError):
        raise MemoryFileError(
            f"{path}: no USD with UsdGeom.Points, or one that is damaged or names other files; "
            "expected a file as gvtools export writes it; export it again"
        ) from None


def points(path: Path) -> Iterator[Item]:
    """Positions and colours of each UsdGeom.Points, for ``read_apart``."""
    from pxr import Sdf, Usd, UsdGeom

    yield {}, {}
    layer = Sdf.Layer.OpenAsAnonymous(str(path))
    if layer is None or layer.GetCompositionAssetDependencies():
        raise ValueError("no layer of its own")
    cache = UsdGeom.XformCache()
    # The stage has to outlive its prims.
    stage = Usd.Stage.Open(layer)
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Points):
            continue
        local = np.asarray(UsdGeom.Points(prim).GetPointsAttr().Get(), np.float64).reshape(-1, 3)
        matrix = np.array(cache.GetLocalToWorldTransform(prim))
        color = UsdGeom.Gprim(prim).GetDisplayColorAttr().Get()
        linear = np.full((1, 3), GREY / 255) if color is None else np.asarray(color, np.float64)
        colors = np.broadcast_to(_srgb(linear), local.shape)
        yield {}, {"positions": local @ matrix[:3, :3] + matrix[3, :3], "colors": colors}


def _srgb(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Linear light as bytes of sRGB."""
    linear = np.clip(linear, 0, 1)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(255 * curved).astype(np.uint8)
