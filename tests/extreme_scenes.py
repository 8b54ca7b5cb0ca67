"""A square before a wall, photographed at any scale and place, and the pictures of its memory."""

from __future__ import annotations

import numpy as np
from memory_scenes import camera
from numpy.typing import ArrayLike

from gvtools.cameras import Cameras
from gvtools.guidance import Guidance
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory

SIZE = {"width": 64, "height": 48}
IMAGES = ("rgb", "depth", "valid", "confidence", "generated")
# Off the grid of voxels: which side of a border a wall falls on is no matter of scale.
SQUARE, WALL, VOXEL = 2.013, 4.037, 0.0207
CENTERS = ((0, 0, 0), (0.3, 0, 0), (0.02, 0.01, 0), (-0.4, 0.1, 0.2), (0.6, 0, 0))


def focal(degrees: float, width: int = SIZE["width"]) -> float:
    """Focal length, pixels, of a horizontal field of view."""
    return width / 2 / float(np.tan(np.radians(degrees / 2)))


def square_before_wall(
    scale: float, *, offset: ArrayLike = (0, 0, 0), origin: ArrayLike | None = None
) -> tuple[SpatialMemory, list[FuseReport]]:
    """Five views in three rounds, the last one generated; lengths are times ``scale``."""
    offset = np.asarray(offset, np.float64)
    memory = SpatialMemory(VOXEL * scale, origin=offset if origin is None else origin)
    reports = []
    for i, place in enumerate(CENTERS):
        center = np.asarray(place, np.float64)
        source = camera(**SIZE, focal=60, center=offset + scale * center)
        at_square = center[:2] + source.rays()[..., :2] * (SQUARE - center[2])
        square = (abs(at_square) <= 0.41).all(-1)
        depth = (np.where(square, SQUARE, WALL) - center[2]) * scale
        rgb = np.where(square[..., None], (255, 40 * i, 0), (0, 40 * i, 255)).astype(np.uint8)
        points = back_project(rgb, depth.astype(np.float32), source, frame=memory.frame)
        reports.append(memory.fuse(points, round=i // 2, generated=i == len(CENTERS) - 1))
    return memory, reports


def target(scale: float, offset: ArrayLike = (0, 0, 0)) -> Cameras:
    """A turned camera between the views of ``square_before_wall``."""
    center = np.asarray(offset, np.float64) + scale * np.array((0.1, 0.05, 0.3))
    return camera(**SIZE, focal=60, center=center, rotation=(0, 0.05, 0.02))


def share_that_differs(one: Guidance, two: Guidance, *, scale: float = 1.0) -> float:
    """The share of pixels that differ by more than 1e-4, depths of ``two`` times ``scale``."""
    off = np.zeros(one.valid.shape, bool)
    for name in IMAGES:
        a = np.asarray(getattr(one, name), np.float64)
        b = np.asarray(getattr(two, name), np.float64)
        a = a / scale if name == "depth" else a
        off |= ~np.isclose(a, b, rtol=1e-4, atol=1e-4).reshape(*off.shape, -1).all(-1)
    return float(off.mean())


def finite(guidance: Guidance) -> bool:
    """Whether no picture holds NaN or infinity, and colours stay in [0, 1] but for rounding."""
    values = (guidance.rgb, guidance.depth, guidance.confidence)
    return all(np.isfinite(v).all() for v in values) and bool((guidance.rgb <= 1 + 1e-6).all())
