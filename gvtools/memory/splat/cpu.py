"""The compiled back end of projection: depth pass, blending pass, resolving.

The image is cut into bands of rows; each band walks the same segments in the same order, so the
result does not depend on how many threads share the work.
"""

# mypy: no-check-untyped-defs

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np
from numba import prange
from numpy.typing import NDArray

from gvtools.kernels import FAST, compiled
from gvtools.memory.culling import REACHABLE, near_to
from gvtools.memory.splat.api import FrameBuffers, SplatOptions, SplatRequest, thinning

if TYPE_CHECKING:
    from gvtools.memory.store.store import Store

# Channels of the accumulator: weighted rgb, weight, weighted z in FrameBuffers.unit, kernel.
CHANNELS = 6
# Confidence x view weight counts as no less: below, sums of float32 would vanish.
FAINTEST = np.float32(1e-36)
# The smallest float32 of full precision, and the least weight that a pixel is divided by.
SMALLEST = np.finfo(np.float32).tiny


class TargetCamera(NamedTuple):
    """A FrameBuffers' camera: pose, and intrinsics in pixels whose centres are at integers."""

    M: NDArray[np.float32]
    fx: np.float32
    fy: np.float32
    skew: np.float32
    cx: np.float32
    cy: np.float32
    focal: np.float32
    z_near: np.float32
    unit: np.float32
    width: int
    height: int


class SplatRules(NamedTuple):
    """See SplatOptions."""

    depth_band: np.float32
    depth_reach: np.float32
    blend_reach: np.float32
    max_splat_px: np.float32


class SegmentRects(NamedTuple):
    """First observation, length and view of each segment, and its rectangle in the image."""

    start: NDArray[np.int64]
    length: NDArray[np.int32]
    view_row: NDArray[np.int32]
    rect: NDArray[np.int32]


@compiled()
def closed_off(u, v, reach, width, height, reachable):
    """Whether a footprint certainly holds no pixel to be written."""
    if not reachable.size or reach > REACHABLE - 1:
        return False
    if not (u >= 0 and u < width and v >= 0 and v < height):
        return False
    return not reachable[np.uint64(np.int64(v) * width + np.int64(u))]


@compiled(fastmath=FAST)
def _project_segment(positions, spacing, lens, factor, max_splat_px, top, bottom, part):
    """Centre-of-pixel coordinates, depth, reach (pixels) and window of one segment's points.

    ``part`` holds scratch rows for the positions and, for these results, u, v, depth, reach and the
    window's first and last column and row. The window is the pixels within reach, cut to the image
    and to the rows ``top`` to ``bottom``; it is empty behind the camera.
    """
    M, z_near, width = lens.M, lens.z_near, lens.width
    fx, fy, skew, cx, cy, focal = lens.fx, lens.fy, lens.skew, lens.cx, lens.cy, lens.focal
    x, y, z, u, v, depth, reach, c0, c1, r0, r1 = part
    m00, m01, m02, m03 = M[0, 0], M[0, 1], M[0, 2], M[0, 3]
    m10, m11, m12, m13 = M[1, 0], M[1, 1], M[1, 2], M[1, 3]
    m20, m21, m22, m23 = M[2, 0], M[2, 1], M[2, 2], M[2, 3]
    one = np.float32(1)
    left = np.float32(-1)
    right = np.float32(width)
    above = np.float32(top - 1)
    below = np.float32(bottom + 1)
    # Apart, because vector units want them so.
    flat = positions.reshape(-1)
    for k in range(len(positions)):
        x[k] = flat[np.uint64(3 * k)]
        y[k] = flat[np.uint64(3 * k + 1)]
        z[k] = flat[np.uint64(3 * k + 2)]
    for k in range(len(positions)):
        px = m00 * x[k] + m01 * y[k] + m02 * z[k] + m03
        py = m10 * x[k] + m11 * y[k] + m12 * z[k] + m13
        pz = m20 * x[k] + m21 * y[k] + m22 * z[k] + m23
        depth[k] = pz
        inverse = one / max(pz, z_near)
        col = (fx * px + skew * py) * inverse + cx
        row = fy * py * inverse + cy
        h = factor * min(max(spacing[k] * focal * inverse, one), max_splat_px)
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
        r1[k] = min(last_row, np.int32(bottom)) if pz > z_near else np.int32(-1)


@compiled(parallel=True, fastmath=FAST)
def splat_segments(
    chosen, segments, columns, view_weight, lens, rules, limit, reachable, threads, blend, fresh,
    depth, total,
):  # fmt: skip
    """Depth pass, then blending inside the depth band, of segments in the order of ``chosen``.

    See SplatRequest for ``limit`` (H x W,) and ``blend``. ``reachable`` (H x W,) bool: the pixels
    within REACHABLE pixels of one to be written; empty when most of the image is open. Out:
    ``depth`` (H x W,), the nearest, or ``limit`` where nothing is nearer; ``total`` (H x W,
    CHANNELS), depths in ``lens.unit``, added to what is there if not ``fresh``.
    """
    width, height = lens.width, lens.height
    rect, start, length, view = segments.rect, segments.start, segments.length, segments.view_row
    positions, color, spacing = columns.positions, columns.colors, columns.spacing
    confidence, depth_band = columns.confidence, rules.depth_band
    longest = 0
    for r in chosen:
        longest = max(longest, length[r])
    one = np.float32(1)
    zero = np.float32(0)
    per_unit = one / lens.unit
    bands = max(1, min(4, height // (16 * threads)))
    for task in prange(bands * threads):
        # Neighbouring bands go to different threads: what is open tends to lie together.
        b = (task % bands) * threads + task // bands
        top = b * height // (bands * threads)
        bottom = (b + 1) * height // (bands * threads) - 1
        floats = np.empty((7, longest), np.float32)
        window = np.empty((4, longest), np.int32)
        u, v, depths, reach = floats[3], floats[4], floats[5], floats[6]
        c0, c1, r0, r1 = window[0], window[1], window[2], window[3]
        part = (floats[0], floats[1], floats[2], u, v, depths, reach, c0, c1, r0, r1)
        for i in range(top * width, (bottom + 1) * width):
            depth[i] = limit[i]
            if blend and fresh and limit[i] > 0:
                for c in range(CHANNELS):
                    total[i, c] = 0
        for r in chosen:
            if rect[r, 3] < top or rect[r, 2] > bottom:
                continue
            first = start[r]
            last = first + length[r]
            _project_segment(
                positions[first:last], spacing[first:last], lens, rules.depth_reach,
                rules.max_splat_px, top, bottom, part,
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
        for r in chosen:
            if rect[r, 3] < top or rect[r, 2] > bottom:
                continue
            first = start[r]
            last = first + length[r]
            weight = view_weight[view[r]]
            _project_segment(
                positions[first:last], spacing[first:last], lens, rules.blend_reach,
                rules.max_splat_px, top, bottom, part,
            )  # fmt: skip
            for k in range(last - first):
                if r0[k] > r1[k] or closed_off(u[k], v[k], reach[k], width, height, reachable):
                    continue
                zk = depths[k]
                q = one / (reach[k] * reach[k])
                near_side = zk / (one + depth_band)
                scale = confidence[first + k] * weight
                scale = max(scale, FAINTEST)
                red = scale * np.float32(color[first + k, 0])
                green = scale * np.float32(color[first + k, 1])
                blue = scale * np.float32(color[first + k, 2])
                far = scale * (zk * per_unit)
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
def resolve(total, open_, support, unit, is_generated, rgb, depth, valid, confidence, generated):
    """Turn accumulators into pixels where ``open_`` and the support suffices."""
    for row in prange(total.shape[0]):
        for col in range(total.shape[1]):
            if not open_[row, col]:
                continue
            kernel = total[row, col, 5]
            weight = total[row, col, 3]
            if kernel < support or not weight >= SMALLEST:
                continue
            scale = np.float32(1) / weight
            for c in range(3):
                rgb[row, col, c] = total[row, col, c] * scale * np.float32(1 / 255)
            depth[row, col] = total[row, col, 4] * scale * unit
            confidence[row, col] = weight / kernel
            generated[row, col] = is_generated
            valid[row, col] = True


class CpuSplatter:
    """Splats segments of a memory on the processor's cores; see splat.api.Splatter."""

    def __init__(self, store: Store, options: SplatOptions) -> None:
        self.store, self.options = store, options
        if store.in_ram:
            store.columns.require_cpu()
        self.zbuffer = np.empty((0, 0), np.float32)
        self.total = np.empty((0, 0, 0), np.float32)

    def splat(self, request: SplatRequest) -> NDArray[np.float32]:
        """See splat.api.Splatter."""
        options, target, segments = self.options, request.target, self.store.segments
        shape, K, single = target.shape, target.camera.K[0], np.float32
        if self.zbuffer.shape != shape:
            self.zbuffer = np.empty(shape, single)
            self.total = np.empty((*shape, CHANNELS), single)
        lens = TargetCamera(
            target.cam_from_local.astype(single), single(K[0, 0]), single(K[1, 1]),
            single(K[0, 1]), single(K[0, 2] - 0.5), single(K[1, 2] - 0.5),
            single(np.sqrt(K[0, 0] * K[1, 1])), target.z_near, target.unit, *shape[::-1],
        )  # fmt: skip
        rules = SplatRules(
            single(options.depth_band), single(options.depth_reach),
            single(options.blend_reach), single(options.max_splat_px),
        )  # fmt: skip
        reachable = np.empty(0, np.bool_)
        if request.writable is not None:
            reachable = near_to(request.writable).ravel()
        parts, limit = list(self.store.tiles.split(segments, request.chosen)), request.limit
        # All are asked for their depth before any is blended: the result is that of one part.
        passes = [(part, False) for part in parts] if len(parts) > 1 or not request.blend else []
        passes += [(part, True) for part in parts] if request.blend else []
        fresh = True
        for part, blend in passes:
            chosen = request.chosen[part]
            detail = thinning(self.store, target, chosen, px=options.far_detail_px)
            rows = self.store.tiles.gather(segments, chosen, doublings=detail)
            rects = SegmentRects(
                rows.start, rows.length, rows.of(segments.view), rows.of(target.rect)
            )
            splat_segments(
                rows.chosen, rects, rows.columns, request.weight, lens, rules, limit.reshape(-1),
                reachable, numba.get_num_threads(), blend, fresh, self.zbuffer.reshape(-1),
                self.total.reshape(-1, CHANNELS),
            )  # fmt: skip
            if blend:
                fresh = False
            else:
                limit = self.zbuffer.copy()
        return self.zbuffer

    def resolve(self, target: FrameBuffers, open_: NDArray[np.bool_], *, generated: bool) -> None:
        """See splat.api.Splatter."""
        resolve(
            self.total, open_, np.float32(self.options.support), target.unit, generated,
            target.rgb, target.depth, target.valid, target.confidence, target.generated,
        )  # fmt: skip
