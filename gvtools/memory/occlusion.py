"""Tests of points against the space that observed rays saw to be free."""

# mypy: no-check-untyped-defs

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled, in_threads
from gvtools.memory.back_projection import FREE_CELL
from gvtools.memory.store.views import FreeGrid


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


# How far a point may be moved out of free space, and in what steps, as shares of its depth.
FARTHEST, STEP = 2.0, 1.02
# Views that are looked at in one call: a call costs as much as some thousand points.
VIEWS_PER_CALL = 32


@compiled()
def _mark(first, last, positions, K, cam_from_world, grids, tolerance, out):
    for i in range(first, last):
        for t in range(len(grids)):
            if out[i]:
                break
            out[i] = seen_through(
                positions[i, 0], positions[i, 1], positions[i, 2],
                K[t], cam_from_world[t], grids[t], tolerance,
            )  # fmt: skip


def in_free_space(
    positions: NDArray[np.float32], views: Sequence[FreeGrid], *, tolerance: float
) -> NDArray[np.bool_]:
    """(N,) points in front of what an observed view measured, by more than ``tolerance`` of depth.

    ``positions`` (N, 3) and the views' cam_from_world are in one frame.
    """
    out = np.zeros(len(positions), np.bool_)
    for first in range(0, len(views), VIEWS_PER_CALL):
        grids = stacked(views[first : first + VIEWS_PER_CALL])
        in_threads(_mark, len(positions), positions, *grids, tolerance, out)
    return out


def behind_free_space(
    origin: NDArray[np.float64],
    rays: NDArray[np.float64],
    depth: NDArray[np.float64],
    *,
    views: Sequence[FreeGrid],
    tolerance: float,
) -> NDArray[np.float64]:
    """Move points along their rays until no view saw past them, see ``in_free_space``.

    The rays (N, 3) go from ``origin`` (3,) to the points at depth 1. Returns the depth (N,), at
    most FARTHEST times as large; 0 where all of that is free.
    """
    out = depth.copy()
    left = np.arange(len(depth))
    factor = 1.0
    while len(left):
        points = origin + rays[left] * (depth[left] * factor)[:, None]
        hit = in_free_space(points.astype(np.float32), views, tolerance=tolerance)
        out[left] = depth[left] * factor
        left = left[hit]
        factor *= STEP
        if factor > FARTHEST:
            out[left] = 0
            break
    return out


def stacked(
    grids: Sequence[FreeGrid],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
    """K (T, 3, 3), cam_from_world (T, 4, 4) and the grids (T, h, w), padded with 0 = unknown."""
    shape = np.max([(1, 1), *(grid.shape for _, _, grid in grids)], axis=0)
    stack = np.zeros((len(grids), *shape), np.float32)
    for row, (_, _, grid) in zip(stack, grids, strict=True):
        row[: grid.shape[0], : grid.shape[1]] = grid
    K = np.array([K for K, _, _ in grids]).reshape(-1, 3, 3)
    return K, np.array([M for _, M, _ in grids]).reshape(-1, 4, 4), stack
