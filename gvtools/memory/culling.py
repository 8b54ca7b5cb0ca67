"""Frustum, occlusion and free-space culling of points and segments."""

# mypy: no-check-untyped-defs

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import FAST, compiled, in_threads
from gvtools.memory.back_projection import FREE_CELL
from gvtools.memory.store.views import FreeGrid


@compiled(inline="always")
def _moved(M, row, x, y, z):
    """A coordinate of (x, y, z) after the rigid motion ``M`` (4, 4)."""
    return M[row, 0] * x + M[row, 1] * y + M[row, 2] * z + M[row, 3]


@compiled()
def seen_through(x, y, z, K, cam_from_world, free_depth, tolerance):
    """Whether the camera saw past (x, y, z): its cell's nearest depth lies clearly behind."""
    depth = _moved(cam_from_world, 2, x, y, z)
    if depth <= 0:
        return False
    cx, cy = _moved(cam_from_world, 0, x, y, z), _moved(cam_from_world, 1, x, y, z)
    column = np.floor(((K[0, 0] * cx + K[0, 1] * cy) / depth + K[0, 2]) / FREE_CELL)
    row = np.floor((K[1, 1] * cy / depth + K[1, 2]) / FREE_CELL)
    if not (0 <= column < free_depth.shape[1] and 0 <= row < free_depth.shape[0]):
        return False
    return depth < free_depth[np.int64(row), np.int64(column)] * (1 - tolerance)


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
        grids = stack_grids(views[first : first + VIEWS_PER_CALL])
        in_threads(_mark, len(positions), positions, *grids, tolerance, out)
    return out


def stack_grids(
    grids: Sequence[FreeGrid],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
    """K (T, 3, 3), cam_from_world (T, 4, 4) and the grids (T, h, w), padded with 0 = unknown."""
    shape = np.max([(1, 1), *(grid.shape for _, _, grid in grids)], axis=0)
    stack = np.zeros((len(grids), *shape), np.float32)
    for row, (_, _, grid) in zip(stack, grids, strict=True):
        row[: grid.shape[0], : grid.shape[1]] = grid
    K = np.array([K for K, _, _ in grids]).reshape(-1, 3, 3)
    return K, np.array([M for _, M, _ in grids]).reshape(-1, 4, 4), stack


TILE = 16
SAMPLE = 6
REACHABLE = 3


def summed_area(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(H + 1, W + 1) summed-area table of a mask (H, W)."""
    table = cv2.integral(mask.view(np.uint8), sdepth=cv2.CV_32S)
    return np.asarray(table, np.int32)


def near_to(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W): pixels with one of ``mask`` within REACHABLE rows and columns."""
    side = 2 * REACHABLE + 1
    return cv2.dilate(mask.view(np.uint8), np.ones((side, side), np.uint8)).view(np.bool_)


def open_mask(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """``mask`` without what holds no square of ``side`` pixels (odd) inside the image."""
    square = np.ones((side, side), np.uint8)
    eroded = cv2.erode(mask.view(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    return cv2.dilate(eroded, square).view(np.bool_)


def tile_farthest(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The farthest depth of each tile of TILE x TILE pixels."""
    height, width = depth.shape
    rows = np.maximum.reduceat(depth, np.arange(0, height, TILE), axis=0)
    return np.maximum.reduceat(rows, np.arange(0, width, TILE), axis=1)


@compiled()
def cull_segments(
    begin, end, boxes, rows, cam_from_local, K, width, height, reach, rect, z_range
):  # fmt: skip
    """Image rectangle and depth range of each segment's box, for a part of ``rows``.

    ``boxes`` are (R, 7), see Segments; footprints extend ``reach`` spacings from their centre. Out:
    ``rect`` (R, 4) int32, first and last column, first and last row, empty (0, -1, 0, -1) when the
    segment is out of view; ``z_range`` (R, 2) float32, nearest and farthest depth.
    """
    focal = max(K[0, 0], K[1, 1])
    for k in range(begin, end):
        i = rows[k]
        low_u, high_u, low_v, high_v, low_z, high_z = _outline(boxes[i], cam_from_local, K)
        rect[i, 0] = 0
        rect[i, 1] = -1
        rect[i, 2] = 0
        rect[i, 3] = -1
        z_range[i, 0] = low_z
        z_range[i, 1] = high_z
        if high_z <= 0:
            continue
        if low_z <= 0:
            # The box crosses the camera plane: its outline is not the corners' outline.
            rect[i, 1] = width - 1
            rect[i, 3] = height - 1
            continue
        pad = max(1.0, reach * boxes[i, 6] * focal / low_z) + 1.0
        if high_u + pad < 0 or low_u - pad >= width or high_v + pad < 0 or low_v - pad >= height:
            continue
        # Clamped before the conversion: beside the camera a column exceeds every integer.
        rect[i, 0] = np.int64(max(0.0, np.floor(low_u - pad)))
        rect[i, 1] = np.int64(min(width - 1.0, np.floor(high_u + pad)))
        rect[i, 2] = np.int64(max(0.0, np.floor(low_v - pad)))
        rect[i, 3] = np.int64(min(height - 1.0, np.floor(high_v + pad)))


@compiled()
def _outline(box, M, K):
    """Least and greatest column, row and depth of a box's corners; columns of those in front."""
    low_u = low_v = low_z = np.inf
    high_u = high_v = high_z = -np.inf
    for corner in range(8):
        x = box[3 * (corner & 1)]
        y = box[1 + 3 * ((corner >> 1) & 1)]
        z = box[2 + 3 * ((corner >> 2) & 1)]
        cx, cy, cz = _moved(M, 0, x, y, z), _moved(M, 1, x, y, z), _moved(M, 2, x, y, z)
        low_z = min(low_z, cz)
        high_z = max(high_z, cz)
        if cz > 0:
            u = (K[0, 0] * cx + K[0, 1] * cy) / cz + K[0, 2]
            v = K[1, 1] * cy / cz + K[1, 2]
            low_u = min(low_u, u)
            high_u = max(high_u, u)
            low_v = min(low_v, v)
            high_v = max(high_v, v)
    return low_u, high_u, low_v, high_v, low_z, high_z


@compiled()
def touching(rect, writable, segments):
    """Those of ``segments`` (n,) whose rectangle holds a pixel to be written.

    ``writable``: (H + 1, W + 1) int32, summed-area table of the pixels to be written.
    """
    out = np.empty(len(segments), np.int64)
    n = 0
    for r in segments:
        c0, c1, r0, r1 = rect[r, 0], rect[r, 1] + 1, rect[r, 2], rect[r, 3] + 1
        if writable[r1, c1] - writable[r0, c1] - writable[r1, c0] + writable[r0, c0] > 0:
            out[n] = r
            n += 1
    return out[:n]


@compiled()
def may_be_in_front(begin, end, segments, rect, z_range, farthest, margin, out):
    """Mark in ``out`` (n,) the segments not wholly behind the ``farthest`` depth of their tiles."""
    share = np.float32(1 - margin)
    for i in range(begin, end):
        r = segments[i]
        bound = np.float32(0)
        for row in range(rect[r, 2] // TILE, rect[r, 3] // TILE + 1):
            for col in range(rect[r, 0] // TILE, rect[r, 1] // TILE + 1):
                bound = max(bound, farthest[row, col])
        out[i] = not z_range[r, 0] >= bound * share


@compiled(fastmath=FAST)
def in_front(
    begin, end, segments, segment_start, segment_length, positions, M, K, depth, margin, grid_K,
    grid_cam, grids, tolerance, hit,
):  # fmt: skip
    """Mark in ``hit`` (n,) those of ``segments`` (n,) with a sampled point in front of ``depth``.

    In front is what is nearer by more than ``margin`` of the depth. Every SAMPLE-th point is looked
    up in the image. A point in space that one of the T views with free-space ``grids`` (T, h, w)
    saw through does not count.
    """
    height, width = depth.shape
    share = np.float32(1 - margin)
    for i in range(begin, end):
        r = segments[i]
        first = segment_start[r]
        for p in range(first, first + segment_length[r], SAMPLE):
            x, y, z = positions[p, 0], positions[p, 1], positions[p, 2]
            pz = _moved(M, 2, x, y, z)
            if pz <= 0:
                continue
            px, py = _moved(M, 0, x, y, z), _moved(M, 1, x, y, z)
            u = (K[0, 0] * px + K[0, 1] * py) / pz + K[0, 2]
            v = K[1, 1] * py / pz + K[1, 2]
            inside = u >= 0 and u < width and v >= 0 and v < height
            if not inside or pz >= depth[np.int64(v), np.int64(u)] * share:
                continue
            free = False
            for t in range(len(grids)):
                free = free or seen_through(x, y, z, grid_K[t], grid_cam[t], grids[t], tolerance)
            if not free:
                hit[i] = True
                break
