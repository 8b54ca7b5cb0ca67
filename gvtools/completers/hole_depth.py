"""Depth of holes: planes of the rim, continued behind what stands in front.

On a plane, inverse depth is a linear function of the pixel. So each rim pixel gets a robust plane
in inverse depth, and each hole pixel looks along sixteen directions for the rim. Two opposite
directions tell what lies between them:

* the planes agree: one surface passes through;
* they cross between the two rims: a room corner or a box edge, each plane counts on its side;
* one stays in front of the other all the way: a step, and the hole is what the nearer surface
  hides (disocclusion), so the farther plane alone continues.

Where one direction of a pair leaves the image, the plane of the other is extrapolated, with less
weight. Among the pairs' answers the weighted lower quantile of inverse depth (the far side) wins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Float64
from gvtools.kernels import compiled, in_threads

# Eight directions (dy, dx); direction k + 8 is the opposite of k.
_HALF = ((0, 1), (1, 2), (1, 1), (2, 1), (1, 0), (2, -1), (1, -1), (1, -2))
DIRECTIONS = np.array(_HALF + tuple((-dy, -dx) for dy, dx in _HALF), np.int64)

# Two inverse depths are of one surface when they differ by less than this share, plus this share
# per pixel of distance (planes fitted to noise drift apart).
SAME_SURFACE = 0.03
SAME_SURFACE_PER_PIXEL = 0.0003
# The quantile of the directions' inverse depths. Steps are told apart pair by pair, so that this
# needs to lean to the far side only a little.
FAR_QUANTILE = 0.45
# A surface in front of another continues into a hole that nothing bounds by at most this share of
# the way to the other's rim.
CONTINUED = 0.15
# A continued plane stays within these multiples of the extreme inverse depths of the view.
FARTHEST, NEAREST = 0.5, 2.0
# Trust in a plane of a generated rim pixel, beside one of an observed.
GENERATED = 0.3
# Known pixels that tell the extremes.
ENOUGH = 20_000


def rim_distance(known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(H, W) distance of each pixel to the nearest known one, pixels; infinite without any."""
    from scipy.ndimage import distance_transform_edt

    if not known.any():
        return np.full(known.shape, np.inf)
    # OpenCV is faster, and its last digit differs from call to call.
    return np.asarray(distance_transform_edt(~known), np.float64)


def hole_radius(valid: NDArray[np.bool_]) -> float:
    """Largest distance of a hole's pixel to a valid one, in image diagonals; may be infinite."""
    return float(rim_distance(valid).max()) / float(np.hypot(*valid.shape))


@dataclass(frozen=True, eq=False)
class HoleDepth:
    """A filled depth map and what it rests on."""

    # (H, W), 1 / scene units; the input where valid, the fill elsewhere, 0 where nothing is known.
    inverse: Float64
    # (16, H, W) row-major index of the first rim pixel in each of ``DIRECTIONS``, -1 where the
    # image ends before.
    hits: NDArray[np.int32]
    # (R, 5) for each rim pixel: inverse depth, its x and y gradients per pixel, trust in [0, 1],
    # relative rms of the fit.
    planes: Float64
    plane_of: NDArray[np.int32]  # (H, W) row of ``planes``, -1 elsewhere
    spread: Float64  # (H, W) relative disagreement of the directions about a filled pixel
    distance: Float64  # (H, W) to the nearest known pixel, pixels; infinite without any


def fill_depth(
    depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    *,
    focal: float,
    steepest_deg: float = 80.0,
    generated: NDArray[np.bool_] | None = None,
) -> HoleDepth:
    """Continue the surfaces around the holes of a z-depth map (H, W) through them.

    A surface seen at a more grazing angle than ``steepest_deg`` counts as a step; ``generated``
    (H, W) are known pixels that a completer made. ``focal`` is in pixels.
    """
    known = valid & (depth > 0) & np.isfinite(depth)
    inverse = np.zeros(depth.shape, np.float64)
    inverse[known] = 1.0 / depth[known].astype(np.float64)
    hits = np.full((len(DIRECTIONS), *known.shape), -1, np.int32)
    in_threads(_first_hits, len(DIRECTIONS), known, DIRECTIONS, hits)
    plane_of = np.full(depth.shape, -1, np.int32)
    touched = np.zeros(known.size + 1, bool)
    touched[hits.reshape(len(hits), -1)[:, np.flatnonzero(~known)]] = True
    # Index -1, no hit, marks the extra last entry.
    rim = np.flatnonzero(touched[:-1])
    plane_of.reshape(-1)[rim] = np.arange(len(rim), dtype=np.int32)
    spread, distance = np.zeros(depth.shape), rim_distance(known)
    if not len(rim):
        return HoleDepth(inverse, hits, np.zeros((0, 5)), plane_of, spread, distance)
    slope = math.tan(math.radians(steepest_deg)) / focal
    planes = np.zeros((len(rim), 5))
    in_threads(_fit_rim, len(rim), inverse, rim, slope, planes)
    if generated is not None:
        planes[generated.reshape(-1)[rim], 3] *= GENERATED
    some = inverse[known]
    low, high = np.percentile(some[:: max(1, some.size // ENOUGH)], (1, 99))
    limits = np.array((FARTHEST * low, NEAREST * high))
    values, weights = np.zeros((len(depth), 8)), np.zeros((len(depth), 8))
    in_threads(
        _combine, len(depth), inverse, known, hits, planes, plane_of.ravel(), slope, limits, spread,
        values, weights,
    )  # fmt: skip
    # Medians, wider the farther from the rim, settle the fill.
    for step in (8, 4, 2, 1, 1):
        settled = inverse.copy()
        in_threads(_median_rows, len(inverse), inverse, known, distance, step, settled)
        inverse = settled
    return HoleDepth(inverse, hits, planes, plane_of, spread, distance)


@compiled()
def _first_hits(first, last, known, directions, hits):
    """Write the first known pixel in each direction, by one sweep per direction."""
    height, width = known.shape
    for k in range(first, last):
        dy, dx = directions[k, 0], directions[k, 1]
        for row in range(height):
            y = height - 1 - row if dy >= 0 else row
            y1 = y + dy
            if y1 < 0 or y1 >= height:
                continue
            for column in range(width):
                x = width - 1 - column if dx >= 0 else column
                x1 = x + dx
                if x1 < 0 or x1 >= width or known[y, x]:
                    continue
                # A knight's move must not leap over a rim one pixel thin.
                if abs(dy) + abs(dx) == 3:
                    ya, xa = (y + dy // 2, x) if abs(dy) == 2 else (y, x + dx // 2)
                    if known[ya, xa]:
                        hits[k, y, x] = ya * width + xa
                        continue
                hits[k, y, x] = y1 * width + x1 if known[y1, x1] else hits[k, y1, x1]


@compiled()
def _fit_rim(first, last, inverse, rim, slope, planes):
    """A robust plane at each rim pixel, from the widest window that one plane explains."""
    width = inverse.shape[1]
    trial = np.zeros(5)
    for i in range(first, last):
        y, x = rim[i] // width, rim[i] % width
        for radius in (24, 12, 6):
            _fit_plane(inverse, y, x, radius, slope, trial)
            if radius == 24 or trial[3] > planes[i, 3]:
                for k in range(5):
                    planes[i, k] = trial[k]
            if planes[i, 3] > 0.5:
                break


@compiled()
def _fit_plane(inverse, y0, x0, radius, slope, out):
    """One window: three passes of least squares over the samples that the last pass explains."""
    height, width = inverse.shape
    center = inverse[y0, x0]
    step = radius // 6
    a, gx, gy = center, 0.0, 0.0
    spread = 0.0
    seen, used = 0, 0
    for turn in range(3):
        n = sx = sy = sxx = sxy = syy = sw = sxw = syw = 0.0
        seen, used = 0, 0
        for dy in range(-radius, radius + 1, step):
            y = y0 + dy
            if y < 0 or y >= height:
                continue
            for dx in range(-radius, radius + 1, step):
                x = x0 + dx
                if x < 0 or x >= width or inverse[y, x] == 0:
                    continue
                seen += 1
                value = inverse[y, x]
                if turn == 0:
                    # Symmetric about the rim pixel, so a steep plane is cut short, not tilted; the
                    # next passes take in the rest of it.
                    reach = center * min(0.015 + slope * math.sqrt(dx * dx + dy * dy), 0.06)
                else:
                    reach = max(2.5 * spread, 0.004 * center)
                if abs(value - (a + gx * dx + gy * dy)) > reach:
                    continue
                used += 1
                n += 1.0
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                value -= center
                sw += value
                sxw += dx * value
                syw += dy * value
        if used < 3:
            out[0], out[1], out[2], out[3], out[4] = center, 0.0, 0.0, 1e-3, 1.0
            return
        # The prior keeps noise from tilting planes: gradients of 0.3 % per pixel are ordinary,
        # and neighbouring samples err together, so each counts for a tenth.
        ridge = 10.0 * (max(spread, 1e-5 * center) / (0.003 * center)) ** 2
        mx, my, mw = sx / n, sy / n, sw / n
        cxx, cyy, cxy = sxx - n * mx * mx + ridge, syy - n * my * my + ridge, sxy - n * mx * my
        cxw, cyw = sxw - n * mx * mw, syw - n * my * mw
        determinant = cxx * cyy - cxy * cxy
        gx = (cxw * cyy - cyw * cxy) / determinant
        gy = (cyw * cxx - cxw * cxy) / determinant
        a = center + mw - gx * mx - gy * my
        squares = 0.0
        for dy in range(-radius, radius + 1, step):
            y = y0 + dy
            if y < 0 or y >= height:
                continue
            for dx in range(-radius, radius + 1, step):
                x = x0 + dx
                if x < 0 or x >= width or inverse[y, x] == 0:
                    continue
                residual = abs(inverse[y, x] - (a + gx * dx + gy * dy))
                # Truncated, so that another surface in the window does not count as noise.
                squares += min(residual, 0.02 * center) ** 2 if residual < 0.06 * center else 0.0
        spread = math.sqrt(squares / max(used, 1))
    relative = spread / center
    support = min(1.0, used / 24.0) * used / max(seen, 1)
    out[0], out[1], out[2] = a, gx, gy
    out[3] = max(1e-3, support / (1.0 + (relative / 0.01) ** 2))
    out[4] = relative


@compiled()
def _pair(p, q, px, py, qx, qy, x, y, slope):
    """Inverse depth at (x, y) between two rim pixels with planes p and q, and its weight."""
    dp = math.sqrt((x - px) ** 2 + (y - py) ** 2)
    dq = math.sqrt((x - qx) ** 2 + (y - qy) ** 2)
    span = dp + dq
    at_p = p[0] + p[1] * (x - px) + p[2] * (y - py)
    at_q = q[0] + q[1] * (x - qx) + q[2] * (y - qy)
    tolerance = SAME_SURFACE + SAME_SURFACE_PER_PIXEL * span + p[4] + q[4]
    # How far each plane lies in front of the other surface, at the other's rim.
    p_over_q = (p[0] + p[1] * (qx - px) + p[2] * (qy - py)) - q[0]
    q_over_p = (q[0] + q[1] * (px - qx) + q[2] * (py - qy)) - p[0]
    low = min(p[0], q[0])
    if abs(p_over_q) < tolerance * q[0] and abs(q_over_p) < tolerance * p[0]:
        trust = min(p[3], q[3])
        return (at_p * dq + at_q * dp) / span, trust / (dp * dq)
    steep = abs(p[0] - q[0]) > 2 * slope * span * low
    if p_over_q * q_over_p > 0 and not steep:
        joint = min(at_p, at_q) if p_over_q > 0 else max(at_p, at_q)
        return joint, 0.5 * min(p[3], q[3]) / (dp * dq)
    # A step: the hole beside the nearer surface is what it hid.
    if p[0] < q[0]:
        return at_p, 0.3 * p[3] / (dp * dp)
    return at_q, 0.3 * q[3] / (dq * dq)


@compiled()
def _unhidden(planes, flat, hits, h, x, y, width, slope):
    """Weight left to rim pixel ``h``, which nothing faces, by farther surfaces seen from (x, y).

    A surface that stands in front of another ends at its silhouette, unless the hole begins at the
    edge of what was photographed. So it continues by a share of the way to the farther rim alone.
    """
    p = planes[flat[h]]
    px, py = h % width, h // width
    near = math.sqrt((x - px) ** 2 + (y - py) ** 2)
    left = 1.0
    for k in range(len(hits)):
        g = hits[k, y, x]
        if g < 0 or g == h:
            continue
        q = planes[flat[g]]
        if q[0] >= p[0]:
            continue
        qx, qy = g % width, g // width
        far = math.sqrt((x - qx) ** 2 + (y - qy) ** 2)
        tolerance = SAME_SURFACE + SAME_SURFACE_PER_PIXEL * (near + far) + p[4] + q[4]
        p_over_q = (p[0] + p[1] * (qx - px) + p[2] * (qy - py)) - q[0]
        q_over_p = (q[0] + q[1] * (px - qx) + q[2] * (py - qy)) - p[0]
        if p_over_q > tolerance * q[0] and q_over_p < -tolerance * p[0]:
            left *= 1.0 - q[3] * min(1.0, near / (CONTINUED * far))
    return left


@compiled()
def _combine(
    first, last, inverse, known, hits, planes, flat, slope, limits, spread, row_values, row_weights
):  # fmt: skip
    """Write the answer of the eight pairs into each hole pixel; the last two (H, 8) are scratch."""
    width = known.shape[1]
    for y in range(first, last):
        values, weights = row_values[y], row_weights[y]
        for x in range(width):
            if known[y, x]:
                continue
            # Of a type: numba compiles what takes a literal once for each of its values.
            count = np.int64(0)
            for k in range(8):
                h0, h1 = hits[k, y, x], hits[k + 8, y, x]
                if h0 < 0 and h1 < 0:
                    continue
                if h0 >= 0 and h1 >= 0:
                    values[count], weights[count] = _pair(
                        planes[flat[h0]], planes[flat[h1]],
                        h0 % width, h0 // width, h1 % width, h1 // width, x, y, slope,
                    )  # fmt: skip
                else:
                    h = h0 if h0 >= 0 else h1
                    plane = planes[flat[h]]
                    dx, dy = x - h % width, y - h // width
                    values[count] = plane[0] + plane[1] * dx + plane[2] * dy
                    weights[count] = 0.4 * plane[3] / (dx * dx + dy * dy)
                    weights[count] *= _unhidden(planes, flat, hits, h, x, y, width, slope)
                count += 1
            if count == 0:
                continue
            value, weight = _weighted_quantile(values, weights, count, FAR_QUANTILE)
            bounded = min(max(value, limits[0]), limits[1])
            inverse[y, x] = bounded
            apart = 0.0
            for i in range(count):
                apart += abs(values[i] - value) * weights[i]
            spread[y, x] = apart / (weight * bounded)


@compiled()
def _weighted_quantile(values, weights, count, share):
    """The smallest of ``count`` values at which ``share`` of the weight is reached; sorts both."""
    for i in range(1, count):
        value, weight = values[i], weights[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1], weights[j + 1] = values[j], weights[j]
            j -= 1
        values[j + 1], weights[j + 1] = value, weight
    total = 0.0
    for i in range(count):
        total += weights[i]
    left = total * share
    for i in range(count):
        left -= weights[i]
        if left <= 0:
            return values[i], total
    return values[count - 1], total


@compiled()
def _median_rows(first, last, inverse, known, distance, step, result):
    """5x5 median with holes of ``step`` pixels between its taps, over the fill alone.

    The taps are point-symmetric sets of hole pixels, so planes stay exact. A wide one acts only
    deep inside, where directions far apart at the rim meet in shards.
    """
    height, width = inverse.shape
    values = np.zeros(25)
    for y in range(first, last):
        for x in range(width):
            if inverse[y, x] == 0 or distance[y, x] < (1 if step == 1 else 4 * step):
                continue
            values[0] = inverse[y, x]
            count = np.int64(1)
            for dy in range(3):
                for dx in range(-2, 3):
                    if dy == 0 and dx <= 0:
                        continue
                    ya, xa = y + dy * step, x + dx * step
                    yb, xb = y - dy * step, x - dx * step
                    if ya >= height or yb < 0 or min(xa, xb) < 0 or max(xa, xb) >= width:
                        continue
                    if known[ya, xa] or known[yb, xb]:
                        continue
                    if inverse[ya, xa] == 0 or inverse[yb, xb] == 0:
                        continue
                    values[count], values[count + 1] = inverse[ya, xa], inverse[yb, xb]
                    count += 2
            # The sets have odd size: the centre and pairs.
            result[y, x] = _middle(values, count)


@compiled()
def _middle(values, count):
    """The median of the first ``count`` values, an odd number; they are rearranged (Hoare 1961)."""
    middle = count // 2
    low, high = 0, count - 1
    while low < high:
        pivot = values[middle]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    return values[middle]
