"""Kernels that spare the splatting its work, and rule on what may stand in front.

Which segments are in view, which of them can still write a pixel, and which hold something nearer
than what the first tier saw.
"""

# mypy: no-check-untyped-defs

from __future__ import annotations

import numpy as np
from numba import prange

from gvtools.kernels import FAST, compiled
from gvtools.memory.occlusion import seen_through

TILE = 16
SAMPLE = 6
REACHABLE = 3


@compiled(parallel=True)
def cull_segments(boxes, rows, cam_from_local, K, width, height, reach, rect, z_range):
    """Image rectangle and depth range of each segment's box.

    Args:
        boxes: (R, 7) float32, see Segments.
        rows: (n,) int64, the boxes that are asked.
        cam_from_local: (4, 4) float64.
        K: (3, 3) float64.
        width: pixels.
        height: pixels.
        reach: footprints extend this many spacings from their centre.
        rect: out (R, 4) int32: first and last column, first and last row; empty (0, -1, 0, -1)
            when the segment is out of view.
        z_range: out (R, 2) float32, nearest and farthest depth.
    """
    focal = max(K[0, 0], K[1, 1])
    for k in prange(len(rows)):
        i = rows[k]
        low_u = np.inf
        high_u = -np.inf
        low_v = np.inf
        high_v = -np.inf
        low_z = np.inf
        high_z = -np.inf
        for corner in range(8):
            x = boxes[i, 3 * (corner & 1)]
            y = boxes[i, 1 + 3 * ((corner >> 1) & 1)]
            w = boxes[i, 2 + 3 * ((corner >> 2) & 1)]
            cx = cam_from_local[0, 0] * x + cam_from_local[0, 1] * y + cam_from_local[0, 2] * w
            cy = cam_from_local[1, 0] * x + cam_from_local[1, 1] * y + cam_from_local[1, 2] * w
            cz = cam_from_local[2, 0] * x + cam_from_local[2, 1] * y + cam_from_local[2, 2] * w
            cx += cam_from_local[0, 3]
            cy += cam_from_local[1, 3]
            cz += cam_from_local[2, 3]
            low_z = min(low_z, cz)
            high_z = max(high_z, cz)
            if cz > 0:
                u = (K[0, 0] * cx + K[0, 1] * cy) / cz + K[0, 2]
                v = K[1, 1] * cy / cz + K[1, 2]
                low_u = min(low_u, u)
                high_u = max(high_u, u)
                low_v = min(low_v, v)
                high_v = max(high_v, v)
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


@compiled(parallel=True, fastmath=FAST)
def in_front(
    segments, segment_start, segment_length, rect, z_range, positions, M, K, depth, farthest,
    margin, grid_K, grid_cam, grids, tolerance,
):  # fmt: skip
    """Those of ``segments`` (n,) with a sampled point in front of ``depth`` by ``margin``.

    A segment wholly behind the farthest depth of its rectangle's tiles (``farthest``) is not
    sampled; of the others, every SAMPLE-th point is looked up in the image. A point in space that
    one of the T views with free-space ``grids`` (T, h, w) saw through does not count.
    """
    height, width = depth.shape
    hit = np.zeros(len(segments), np.bool_)
    share = np.float32(1 - margin)
    for i in prange(len(segments)):
        r = segments[i]
        bound = np.float32(0)
        for row in range(rect[r, 2] // TILE, rect[r, 3] // TILE + 1):
            for col in range(rect[r, 0] // TILE, rect[r, 1] // TILE + 1):
                bound = max(bound, farthest[row, col])
        if z_range[r, 0] >= bound * share:
            continue
        first = segment_start[r]
        for p in range(first, first + segment_length[r], SAMPLE):
            x, y, z = positions[p, 0], positions[p, 1], positions[p, 2]
            pz = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
            if pz <= 0:
                continue
            px = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]
            py = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]
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
    return segments[hit]


@compiled(parallel=True)
def still_open(valid, open_, limit):
    """Write what later tiers may fill: ``open_`` where not ``valid``, and as limit inf or 0."""
    for row in prange(valid.shape[0]):
        for col in range(valid.shape[1]):
            done = valid[row, col]
            open_[row, col] = not done
            limit[row, col] = np.float32(0) if done else np.float32(np.inf)


@compiled()
def summed_area(mask):
    """(H + 1, W + 1) int32 summed-area table of a boolean image."""
    height, width = mask.shape
    table = np.zeros((height + 1, width + 1), np.int32)
    for row in range(height):
        line = np.int32(0)
        for col in range(width):
            line += mask[row, col]
            table[row + 1, col + 1] = table[row, col + 1] + line
    return table


@compiled(parallel=True)
def near_to(table):
    """(H x W,) bool: pixels with one of the summed-area ``table`` within REACHABLE pixels."""
    height, width = table.shape[0] - 1, table.shape[1] - 1
    out = np.empty(height * width, np.bool_)
    for row in prange(height):
        r0, r1 = max(row - REACHABLE, 0), min(row + REACHABLE + 1, height)
        for col in range(width):
            c0, c1 = max(col - REACHABLE, 0), min(col + REACHABLE + 1, width)
            count = table[r1, c1] - table[r0, c1] - table[r1, c0] + table[r0, c0]
            out[row * width + col] = count > 0
    return out


@compiled(parallel=True)
def tile_farthest(depth):
    """The farthest depth of each tile of TILE pixels."""
    height, width = depth.shape
    out = np.zeros(((height + TILE - 1) // TILE, (width + TILE - 1) // TILE), np.float32)
    for i in prange(out.shape[0]):
        for row in range(i * TILE, min((i + 1) * TILE, height)):
            for col in range(width):
                out[i, col // TILE] = max(out[i, col // TILE], depth[row, col])
    return out


@compiled(parallel=True)
def not_free(depth, limit, cam_from_local, K, grid_K, grid_cam, grids, tolerance):
    """(H, W) bool: pixels with a depth below ``limit`` whose place no grid's view saw through."""
    height, width = depth.shape
    out = np.zeros((height, width), np.bool_)
    for row in prange(height):
        ry = (row + 0.5 - K[1, 2]) / K[1, 1]
        for col in range(width):
            z = np.float64(depth[row, col])
            if not z < limit[row, col]:
                continue
            rx = (col + 0.5 - K[0, 2] - K[0, 1] * ry) / K[0, 0]
            a = rx * z - cam_from_local[0, 3]
            b = ry * z - cam_from_local[1, 3]
            c = z - cam_from_local[2, 3]
            M = cam_from_local
            x = np.float32(M[0, 0] * a + M[1, 0] * b + M[2, 0] * c)
            y = np.float32(M[0, 1] * a + M[1, 1] * b + M[2, 1] * c)
            w = np.float32(M[0, 2] * a + M[1, 2] * b + M[2, 2] * c)
            free = False
            for t in range(len(grids)):
                free = free or seen_through(x, y, w, grid_K[t], grid_cam[t], grids[t], tolerance)
            out[row, col] = not free
    return out


@compiled(parallel=True)
def opened(mask, side):
    """``mask`` without what holds no square of ``side`` pixels (odd) around any of its pixels."""
    half = side // 2
    height, width = mask.shape
    table = summed_area(mask)
    out = np.zeros_like(mask)
    # Rows of several threads may write a pixel twice, but only ever the same True.
    for row in prange(half, height - half):
        for col in range(half, width - half):
            if not mask[row, col]:
                continue
            r0, r1, c0, c1 = row - half, row + half + 1, col - half, col + half + 1
            count = table[r1, c1] - table[r0, c1] - table[r1, c0] + table[r0, c0]
            if count == side * side:
                out[r0:r1, c0:c1] = True
    return out
