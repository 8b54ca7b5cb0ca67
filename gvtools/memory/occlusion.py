"""Which points would stand in space that an observed ray saw to be free."""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from gvtools.memory.back_projection import FREE_CELL
from gvtools.memory.compiled import compiled


@compiled()
def seen_through(x, y, z, K, cam_from_world, free_depth, tolerance):
    """Whether the camera saw past (x, y, z): its cell's nearest depth lies clearly behind."""
    depth = (
        cam_from_world[2, 0] * x
        + cam_from_world[2, 1] * y
        + cam_from_world[2, 2] * z
        + cam_from_world[2, 3]
    )
    if depth <= 0:
        return False
    cx = (
        cam_from_world[0, 0] * x
        + cam_from_world[0, 1] * y
        + cam_from_world[0, 2] * z
        + cam_from_world[0, 3]
    )
    cy = (
        cam_from_world[1, 0] * x
        + cam_from_world[1, 1] * y
        + cam_from_world[1, 2] * z
        + cam_from_world[1, 3]
    )
    column = np.floor(((K[0, 0] * cx + K[0, 1] * cy) / depth + K[0, 2]) / FREE_CELL)
    row = np.floor((K[1, 1] * cy / depth + K[1, 2]) / FREE_CELL)
    if not (0 <= column < free_depth.shape[1] and 0 <= row < free_depth.shape[0]):
        return False
    return depth < free_depth[np.int64(row), np.int64(column)] * (1 - tolerance)


@compiled(parallel=True)
def _mark(positions, K, cam_from_world, free_depth, tolerance, out):
    for i in prange(len(positions)):
        if not out[i]:
            out[i] = seen_through(
                positions[i, 0], positions[i, 1], positions[i, 2],
                K, cam_from_world, free_depth, tolerance,
            )  # fmt: skip


def in_free_space(
    positions: NDArray[np.float32],
    views: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]],
    *,
    tolerance: float,
) -> NDArray[np.bool_]:
    """Points that lie in front of what a view measured, by more than ``tolerance`` of its depth.

    Args:
        positions: (N, 3) float32, scene units.
        views: per observed view K (3, 3), cam_from_world (4, 4) in the positions' frame and its
            free-space grid (h, w) (see PointSet).
        tolerance: relative margin that depth noise is allowed.

    Returns:
        (N,) bool.
    """
    out = np.zeros(len(positions), np.bool_)
    for K, cam_from_world, free_depth in views:
        if free_depth.size:
            _mark(positions, K, cam_from_world, free_depth, tolerance, out)
    return out
