"""The splatting kernels: culling of runs, depth pass, blending pass, resolving.

The image is cut into bands of rows; each band walks the same runs in the same order, so the result
does not depend on how many threads share the work.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from gvtools.memory.compiled import FAST, compiled
from gvtools.memory.occlusion import seen_through

# Channels of the accumulator: weighted rgb, weight, weighted z, kernel.
CHANNELS = 6
NEAR = 1e-6
TILE = 16
SAMPLE = 6
REACHABLE = 3


@compiled(parallel=True)
def cull_runs(boxes, rows, cam_from_local, K, width, height, reach, rect, z_range):
    """Image rectangle and depth range of each run's box.

    Args:
        boxes: (R, 7) float32, see Runs.
        rows: (n,) int64, the boxes that are asked.
        cam_from_local: (4, 4) float64.
        K: (3, 3) float64.
        width: pixels.
        height: pixels.
        reach: footprints extend this many spacings from their centre.
        rect: out (R, 4) int32: first and last column, first and last row; empty (0, -1, 0, -1)
            when the run is out of view.
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
            if cz > NEAR:
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
        if high_z <= NEAR:
            continue
        if low_z <= NEAR:
            # The box crosses the camera plane: its outline is not the corners' outline.
            rect[i, 1] = width - 1
            rect[i, 3] = height - 1
            continue
        pad = max(1.0, reach * boxes[i, 6] * focal / low_z) + 1.0
        if high_u + pad < 0 or low_u - pad >= width or high_v + pad < 0 or low_v - pad >= height:
            continue
        rect[i, 0] = max(0, np.int64(np.floor(low_u - pad)))
        rect[i, 1] = min(width - 1, np.int64(np.floor(high_u + pad)))
        rect[i, 2] = max(0, np.int64(np.floor(low_v - pad)))
        rect[i, 3] = min(height - 1, np.int64(np.floor(high_v + pad)))


@compiled()
def touching(rect, writable, runs):
    """Those of ``runs`` (n,) whose rectangle holds a pixel to be written.

    ``writable``: (H + 1, W + 1) int32, summed-area table of the pixels to be written.
    """
    out = np.empty(len(runs), np.int64)
    n = 0
    for r in runs:
        c0, c1, r0, r1 = rect[r, 0], rect[r, 1] + 1, rect[r, 2], rect[r, 3] + 1
        if writable[r1, c1] - writable[r0, c1] - writable[r1, c0] + writable[r0, c0] > 0:
            out[n] = r
            n += 1
    return out[:n]


@compiled(parallel=True, fastmath=FAST)
def in_front(
    runs, run_start, run_length, rect, z_range, x, y, z, M, K, depth, farthest, margin,
    grid_K, grid_cam, grids, tolerance,
):  # fmt: skip
    """Those of ``runs`` (n,) of which a sampled point lies in front of ``depth`` by ``margin``.

    A run wholly behind the farthest depth of its rectangle's tiles (``farthest``) is not sampled;
    of the others, every SAMPLE-th point is looked up in the image. A point in space that one of
    the T views with free-space ``grids`` (T, h, w) saw through does not count.
    """
    height, width = depth.shape
    hit = np.zeros(len(runs), np.bool_)
    share = np.float32(1 - margin)
    for i in prange(len(runs)):
        r = runs[i]
        bound = np.float32(0)
        for row in range(rect[r, 2] // TILE, rect[r, 3] // TILE + 1):
            for col in range(rect[r, 0] // TILE, rect[r, 1] // TILE + 1):
                bound = max(bound, farthest[row, col])
        if z_range[r, 0] >= bound * share:
            continue
        first = run_start[r]
        for p in range(first, first + run_length[r], SAMPLE):
            pz = M[2, 0] * x[p] + M[2, 1] * y[p] + M[2, 2] * z[p] + M[2, 3]
            if pz <= NEAR:
                continue
            px = M[0, 0] * x[p] + M[0, 1] * y[p] + M[0, 2] * z[p] + M[0, 3]
            py = M[1, 0] * x[p] + M[1, 1] * y[p] + M[1, 2] * z[p] + M[1, 3]
            u = (K[0, 0] * px + K[0, 1] * py) / pz + K[0, 2]
            v = K[1, 1] * py / pz + K[1, 2]
            inside = u >= 0 and u < width and v >= 0 and v < height
            if not inside or pz >= depth[np.int64(v), np.int64(u)] * share:
                continue
            free = False
            for t in range(len(grids)):
                free = free or seen_through(
                    x[p], y[p], z[p], grid_K[t], grid_cam[t], grids[t], tolerance
                )
            if not free:
                hit[i] = True
                break
    return runs[hit]


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


@compiled(inline="always")
def closed_off(u, v, reach, width, height, reachable):
    """Whether a footprint certainly holds no pixel to be written."""
    if not reachable.size or reach > REACHABLE - 1:
        return False
    if not (u >= 0 and u < width and v >= 0 and v < height):
        return False
    return not reachable[np.uint64(np.int64(v) * width + np.int64(u))]


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


@compiled(fastmath=FAST)
def _project_run(
    x, y, z, spacing, M, fx, fy, skew, cx, cy, focal, near, factor, size_cap, width, top, bottom,
    u, v, depth, reach, c0, c1, r0, r1,
):  # fmt: skip
    """Centre-of-pixel coordinates, depth, reach (pixels) and window of one run's points.

    The window is the pixels within reach, cut to the image and to the rows ``top`` to ``bottom``;
    it is empty behind the camera.
    """
    m00, m01, m02, m03 = M[0, 0], M[0, 1], M[0, 2], M[0, 3]
    m10, m11, m12, m13 = M[1, 0], M[1, 1], M[1, 2], M[1, 3]
    m20, m21, m22, m23 = M[2, 0], M[2, 1], M[2, 2], M[2, 3]
    one = np.float32(1)
    left = np.float32(-1)
    right = np.float32(width)
    above = np.float32(top - 1)
    below = np.float32(bottom + 1)
    for k in range(len(x)):
        px = m00 * x[k] + m01 * y[k] + m02 * z[k] + m03
        py = m10 * x[k] + m11 * y[k] + m12 * z[k] + m13
        pz = m20 * x[k] + m21 * y[k] + m22 * z[k] + m23
        depth[k] = pz
        inverse = one / max(pz, near)
        col = (fx * px + skew * py) * inverse + cx
        row = fy * py * inverse + cy
        h = factor * min(max(spacing[k] * focal * inverse, one), size_cap)
        u[k] = col
        v[k] = row
        reach[k] = h
        # Clamped before the conversion: far out of view a column exceeds every integer.
        first_col = np.int32(np.ceil(min(max(col - h, left), right)))
        last_col = np.int32(np.floor(min(max(col + h, left), right)))
        first_row = np.int32(np.ceil(min(max(row - h, above), below)))
        last_row = np.int32(np.floor(min(max(row + h, above), below)))
        c0[k] = max(first_col, np.int32(0))
        c1[k] = min(last_col, np.int32(width - 1))
        r0[k] = max(first_row, np.int32(top))
        r1[k] = min(last_row, np.int32(bottom)) if pz > near else np.int32(-1)


@compiled(parallel=True, fastmath=FAST)
def splat_runs(
    runs, run_start, run_length, run_view, rect, x, y, z, color, confidence, agreement, spacing,
    view_weight, M, K, near, limit, reachable, band, depth_reach, blend_reach, size_cap, weight_cap,
    threads, blend, width, height, depth, total,
):  # fmt: skip
    """Depth pass, then blending inside the depth band.

    ``runs`` (n,) are added in their order. Only what is nearer than ``limit`` (H x W,) makes a
    depth; 0 shuts a pixel. ``reachable`` (H x W,) bool holds the pixels within REACHABLE pixels of
    one to be written; it is empty when most of the image is open. ``band`` is the relative depth
    band that blends; ``depth_reach`` and ``blend_reach`` are the footprints' half width and the
    kernel's radius in spacings; footprints wider than ``size_cap`` pixels are cut to it. Without
    ``blend`` it stops after the depth pass.

    Writes ``depth`` (H x W,) float32, the nearest depth, or ``limit`` where nothing is nearer, and
    ``total`` (H x W, CHANNELS) float32.
    """
    fx = np.float32(K[0, 0])
    fy = np.float32(K[1, 1])
    skew = np.float32(K[0, 1])
    cx = np.float32(K[0, 2] - 0.5)
    cy = np.float32(K[1, 2] - 0.5)
    focal = np.float32(np.sqrt(K[0, 0] * K[1, 1]))
    longest = 0
    for r in runs:
        longest = max(longest, run_length[r])
    one = np.float32(1)
    zero = np.float32(0)
    bands = max(1, min(4, height // (16 * threads)))
    for task in prange(bands * threads):
        # Neighbouring bands go to different threads: what is open tends to lie together.
        b = (task % bands) * threads + task // bands
        top = b * height // (bands * threads)
        bottom = (b + 1) * height // (bands * threads) - 1
        u = np.empty(longest, np.float32)
        v = np.empty(longest, np.float32)
        depths = np.empty(longest, np.float32)
        reach = np.empty(longest, np.float32)
        c0 = np.empty(longest, np.int32)
        c1 = np.empty(longest, np.int32)
        r0 = np.empty(longest, np.int32)
        r1 = np.empty(longest, np.int32)
        for i in range(top * width, (bottom + 1) * width):
            depth[i] = limit[i]
            if blend and limit[i] > 0:
                total[i] = 0
        for r in runs:
            if rect[r, 3] < top or rect[r, 2] > bottom:
                continue
            first = run_start[r]
            last = first + run_length[r]
            _project_run(
                x[first:last], y[first:last], z[first:last], spacing[first:last], M, fx, fy, skew,
                cx, cy, focal, near, depth_reach, size_cap, width, top, bottom,
                u, v, depths, reach, c0, c1, r0, r1,
            )  # fmt: skip
            for k in range(last - first):
                if closed_off(u[k], v[k], reach[k], width, height, reachable):
                    continue
                zk = depths[k]
                for row in range(r0[k], r1[k] + 1):
                    for col in range(c0[k], c1[k] + 1):
                        # Unsigned: the compiler need not ask for negative indices.
                        cell = np.uint64(row * width + col)
                        if zk < depth[cell]:
                            depth[cell] = zk
        if not blend:
            continue
        for r in runs:
            if rect[r, 3] < top or rect[r, 2] > bottom:
                continue
            first = run_start[r]
            last = first + run_length[r]
            proximity = view_weight[run_view[r]]
            _project_run(
                x[first:last], y[first:last], z[first:last], spacing[first:last], M, fx, fy, skew,
                cx, cy, focal, near, blend_reach, size_cap, width, top, bottom,
                u, v, depths, reach, c0, c1, r0, r1,
            )  # fmt: skip
            for k in range(last - first):
                if r0[k] > r1[k] or closed_off(u[k], v[k], reach[k], width, height, reachable):
                    continue
                zk = depths[k]
                q = one / (reach[k] * reach[k])
                near_side = zk / (one + band)
                scale = min(confidence[first + k] + agreement[first + k], weight_cap) * proximity
                red = scale * np.float32(color[first + k, 0])
                green = scale * np.float32(color[first + k, 1])
                blue = scale * np.float32(color[first + k, 2])
                far = scale * zk
                for row in range(r0[k], r1[k] + 1):
                    dy = np.float32(row) - v[k]
                    for col in range(c0[k], c1[k] + 1):
                        cell = np.uint64(row * width + col)
                        if near_side > depth[cell]:
                            continue
                        dx = np.float32(col) - u[k]
                        kernel = max(one - q * (dx * dx + dy * dy), zero)
                        kernel *= kernel
                        total[cell, 0] += kernel * red
                        total[cell, 1] += kernel * green
                        total[cell, 2] += kernel * blue
                        total[cell, 3] += kernel * scale
                        total[cell, 4] += kernel * far
                        total[cell, 5] += kernel


@compiled(parallel=True, fastmath=FAST)
def resolve(total, open_, support, made, rgb, depth, valid, confidence, generated):
    """Turn accumulators into pixels where ``open_`` and the support suffices."""
    for row in prange(total.shape[0]):
        for col in range(total.shape[1]):
            if not open_[row, col]:
                continue
            kernel = total[row, col, 5]
            weight = total[row, col, 3]
            if kernel < support or not weight > 0:
                continue
            scale = np.float32(1) / weight
            for c in range(3):
                rgb[row, col, c] = total[row, col, c] * scale * np.float32(1 / 255)
            depth[row, col] = total[row, col, 4] * scale
            confidence[row, col] = weight / kernel
            generated[row, col] = made
            valid[row, col] = True
