"""The compiled kernels of stereo; gvtools.depth.stereo.matching defines their results."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray

from gvtools.depth.stereo.matching import CONTRAST, DIRECTIONS, LARGE, SMALL, Level, Matcher
from gvtools.kernels import FAST, compiled

Float32 = NDArray[np.float32]

# The cost of a pixel that a source does not show, and of one without any likeness.
UNSEEN = np.float32(1)
ONE = np.float32(1)
HALF = np.float32(0.5)
ZERO = np.float32(0)


class CpuMatcher(Matcher):
    """Matching by compiled kernels, on all cores."""

    def score(self, level: Level, planes: torch.Tensor) -> torch.Tensor:
        """See Matcher.score."""
        cost = np.empty(tuple(level.reference.shape), np.float32)
        window = planes.contiguous().numpy(), level.weights.numpy(), level.taps.numpy()
        _score(*_pictures(level), *window, self.best(level), self.options.noise, cost)
        return torch.from_numpy(cost)

    def sweep(self, level: Level, inverse_depths: torch.Tensor) -> torch.Tensor:
        """See Matcher.sweep."""
        volume = np.empty((*level.reference.shape, len(inverse_depths)), np.float32)
        window, noise = self.options.window, self.options.noise
        planes = inverse_depths.numpy()
        _sweep(*_pictures(level), planes, window, self.best(level), noise, volume)
        return torch.from_numpy(volume)

    def aggregate(self, volume: torch.Tensor, guide: torch.Tensor) -> torch.Tensor:
        """See Matcher.aggregate."""
        directions = np.array(DIRECTIONS)
        paths = np.empty((len(directions), *volume.shape), np.float32)
        _aggregate(volume.numpy(), guide.numpy(), directions, SMALL, LARGE, CONTRAST, paths)
        return torch.from_numpy(paths).mean(0)


def _pictures(level: Level) -> tuple[Any, Any, Any, Any, Any]:
    """A level's reference, sources, sizes, matrix and offset."""
    return (
        level.reference.numpy(),
        level.sources.numpy(),
        level.sizes.numpy(),
        level.matrix.numpy(),
        level.offset.numpy(),
    )


@compiled(fastmath=FAST, inline="always")
def _clamped(value: np.float32, most: np.float32) -> np.float32:
    value = value if value > ZERO else ZERO
    return value if value < most else most


@compiled(fastmath=FAST)
def _mean_of_best(costs: Float32, best: int) -> np.float32:
    """Mean of the ``best`` lowest costs, which are overwritten."""
    total = ZERO
    for _ in range(best):
        lowest = 0
        for s in range(1, len(costs)):
            if costs[s] < costs[lowest]:
                lowest = s
        total += costs[lowest]
        costs[lowest] = np.float32(1e9)
    return total / np.float32(best)


@compiled(parallel=True, fastmath=FAST)
def _score(
    reference: Float32,
    sources: Float32,
    sizes: NDArray[np.int32],
    matrix: Float32,
    offset: Float32,
    planes: Float32,
    weights: Float32,
    taps: NDArray[np.int32],
    best: int,
    noise: float,
    cost: Float32,
) -> None:
    """See Matcher.score; the result goes to ``cost``."""
    height, width = reference.shape
    count, stride, n = len(sources), sources.shape[2], len(taps)
    floor = np.float32(noise * noise)
    tx, ty = taps[:, 0].astype(np.float32), taps[:, 1].astype(np.float32)
    step = np.uint32(stride)
    one = np.uint32(1)
    for y in prange(height):
        r, fx, fy = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
        v00, v01 = np.empty(n, np.float32), np.empty(n, np.float32)
        v10, v11 = np.empty(n, np.float32), np.empty(n, np.float32)
        cell = np.empty(n, np.int32)
        costs = np.empty(count, np.float32)
        v = np.float32(y) + HALF
        for x in range(width):
            g = weights[y, x]
            # Sums of differences to the centre's luminance lose less to rounding.
            center = reference[y, x]
            u = np.float32(x) + HALF
            w, a, b = planes[0, y, x], planes[1, y, x], planes[2, y, x]
            for t in range(n):
                row = min(max(y + taps[t, 1], 0), height - 1)
                r[t] = reference[row, min(max(x + taps[t, 0], 0), width - 1)] - center
            sum_r, sum_rr = ZERO, ZERO
            for t in range(n):
                gr = g[t] * r[t]
                sum_r += gr
                sum_rr += gr * r[t]
            variance_r = max(sum_rr - sum_r * sum_r, ZERO) + floor
            for s in range(count):
                costs[s] = UNSEEN
                A, o = matrix[s], offset[s]
                z = A[2, 0] * u + A[2, 1] * v + A[2, 2] + w * o[2]
                if not z > np.float32(1e-6):
                    continue
                inverse = ONE / z
                px = (A[0, 0] * u + A[0, 1] * v + A[0, 2] + w * o[0]) * inverse
                py = (A[1, 0] * u + A[1, 1] * v + A[1, 2] + w * o[1]) * inverse
                wide, high = np.float32(sizes[s, 0]), np.float32(sizes[s, 1])
                if not (px > ZERO and py > ZERO and px < wide and py < high):
                    continue
                # Over the window the homography is taken as affine: its derivative at the centre.
                zu, zv = A[2, 0] + a * o[2], A[2, 1] + b * o[2]
                xu = (A[0, 0] + a * o[0] - px * zu) * inverse
                xv = (A[0, 1] + b * o[0] - px * zv) * inverse
                yu = (A[1, 0] + a * o[1] - py * zu) * inverse
                yv = (A[1, 1] + b * o[1] - py * zv) * inverse
                px -= HALF
                py -= HALF
                right, bottom = wide - np.float32(1.001), high - np.float32(1.001)
                flat = sources[s].reshape(-1)
                # Three loops: the first and the last become vector instructions.
                for t in range(n):
                    qx = _clamped(px + xu * tx[t] + xv * ty[t], right)
                    qy = _clamped(py + yu * tx[t] + yv * ty[t], bottom)
                    column, line = np.int32(qx), np.int32(qy)
                    fx[t] = qx - np.float32(column)
                    fy[t] = qy - np.float32(line)
                    cell[t] = line * np.int32(stride) + column
                for t in range(n):
                    k = np.uint32(cell[t])
                    v00[t], v01[t] = flat[k], flat[k + one]
                    v10[t], v11[t] = flat[k + step], flat[k + step + one]
                sum_s, sum_ss, sum_rs = ZERO, ZERO, ZERO
                for t in range(n):
                    top = v00[t] + fx[t] * (v01[t] - v00[t])
                    value = v10[t] + fx[t] * (v11[t] - v10[t])
                    value = top + fy[t] * (value - top) - center
                    gs = g[t] * value
                    sum_s += gs
                    sum_ss += gs * value
                    sum_rs += gs * r[t]
                variance_s = max(sum_ss - sum_s * sum_s, ZERO) + floor
                likeness = (sum_rs - sum_r * sum_s) / np.sqrt(variance_r * variance_s)
                costs[s] = ONE - max(likeness, ZERO)
            cost[y, x] = _mean_of_best(costs, best)


@compiled(fastmath=FAST)
def _warp_plane(
    source: Float32, size: NDArray[np.int32], A: Float32, o: Float32, w: np.float32, image: Float32
) -> None:
    """The source as the reference would see it on one plane; -9 where it does not show it."""
    height, width = image.shape
    stride = source.shape[1]
    flat = source.reshape(-1)
    wide, high = np.float32(size[0]), np.float32(size[1])
    right, bottom = wide - np.float32(1.001), high - np.float32(1.001)
    step, one = np.uint32(stride), np.uint32(1)
    cell, inside = np.empty(width, np.int32), np.empty(width, np.float32)
    fx, fy = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(height):
        v = np.float32(y) + HALF
        x0 = A[0, 1] * v + A[0, 2] + w * o[0]
        y0 = A[1, 1] * v + A[1, 2] + w * o[1]
        z0 = A[2, 1] * v + A[2, 2] + w * o[2]
        for x in range(width):
            u = np.float32(x) + HALF
            z = A[2, 0] * u + z0
            inverse = ONE / max(z, np.float32(1e-6))
            px, py = (A[0, 0] * u + x0) * inverse, (A[1, 0] * u + y0) * inverse
            ahead = (z > np.float32(1e-6)) & (px > ZERO) & (py > ZERO) & (px < wide) & (py < high)
            inside[x] = ONE if ahead else ZERO
            qx, qy = _clamped(px - HALF, right), _clamped(py - HALF, bottom)
            column, line = np.int32(qx), np.int32(qy)
            fx[x] = qx - np.float32(column)
            fy[x] = qy - np.float32(line)
            cell[x] = line * np.int32(stride) + column
        for x in range(width):
            k = np.uint32(cell[x])
            top = flat[k] + fx[x] * (flat[k + one] - flat[k])
            low = flat[k + step] + fx[x] * (flat[k + step + one] - flat[k + step])
            image[y, x] = top + fy[x] * (low - top) if inside[x] > ZERO else np.float32(-9)


@compiled(fastmath=FAST)
def _box_row(image: Float32, other: Float32, y: int, radius: int, columns: Float32) -> None:
    """Sums over the rows of a window round row ``y``: of image, image², image x other."""
    height, width = image.shape
    columns[:, radius : radius + width] = ZERO
    for j in range(-radius, radius + 1):
        row = min(max(y + j, 0), height - 1)
        for x in range(width):
            value = max(image[row, x], ZERO)
            columns[0, radius + x] += value
            columns[1, radius + x] += value * value
            columns[2, radius + x] += value * other[row, x]
    for k in range(3):
        for x in range(radius):
            columns[k, x] = columns[k, radius]
            columns[k, radius + width + x] = columns[k, radius + width - 1]


@compiled(parallel=True, fastmath=FAST)
def _sweep(
    reference: Float32,
    sources: Float32,
    sizes: NDArray[np.int32],
    matrix: Float32,
    offset: Float32,
    inverse_depths: Float32,
    window: int,
    best: int,
    noise: float,
    volume: Float32,
) -> None:
    """See Matcher.sweep; the result goes to ``volume``."""
    height, width = reference.shape
    count = len(sources)
    radius = window // 2
    floor = np.float32(noise * noise)
    scale = ONE / np.float32(window * window)
    mean, variance = np.empty_like(reference), np.empty_like(reference)
    for y in prange(height):
        columns = np.empty((3, width + 2 * radius), np.float32)
        _box_row(reference, reference, y, radius, columns)
        for x in range(width):
            first, second = ZERO, ZERO
            for i in range(window):
                first += columns[0, x + i]
                second += columns[1, x + i]
            mean[y, x] = first * scale
            variance[y, x] = max(second * scale - (first * scale) ** 2, ZERO) + floor
    for d in prange(len(inverse_depths)):
        image = np.empty((height, width), np.float32)
        costs = np.empty((count, height, width), np.float32)
        columns = np.empty((3, width + 2 * radius), np.float32)
        for s in range(count):
            _warp_plane(sources[s], sizes[s], matrix[s], offset[s], inverse_depths[d], image)
            for y in range(height):
                _box_row(image, reference, y, radius, columns)
                for x in range(width):
                    first, second, product = ZERO, ZERO, ZERO
                    for i in range(window):
                        first += columns[0, x + i]
                        second += columns[1, x + i]
                        product += columns[2, x + i]
                    first *= scale
                    spread = max(second * scale - first * first, ZERO) + floor
                    likeness = product * scale - first * mean[y, x]
                    likeness /= np.sqrt(spread * variance[y, x])
                    seen = image[y, x] >= ZERO
                    costs[s, y, x] = ONE - max(likeness, ZERO) if seen else UNSEEN
        at = np.empty(count, np.float32)
        for y in range(height):
            for x in range(width):
                for s in range(count):
                    at[s] = costs[s, y, x]
                volume[y, x, d] = _mean_of_best(at, best)


@compiled(fastmath=FAST)
def _step(
    cost: Float32, before: Float32, small: np.float32, large: np.float32, after: Float32
) -> None:
    """One pixel of a path: its own costs plus the cheapest way from the pixel before."""
    n = len(cost)
    least = before[0]
    for d in range(1, n):
        least = min(least, before[d])
    jump = least + large
    after[0] = cost[0] + min(min(before[0], before[1] + small), jump) - least
    for d in range(1, n - 1):
        near = min(before[d - 1], before[d + 1]) + small
        after[d] = cost[d] + min(min(before[d], near), jump) - least
    after[n - 1] = cost[n - 1] + min(min(before[n - 1], before[n - 2] + small), jump) - least


@compiled(parallel=True, fastmath=FAST)
def _aggregate(
    volume: Float32,
    guide: Float32,
    directions: NDArray[np.int64],
    small: float,
    large: float,
    contrast: float,
    paths: Float32,
) -> None:
    """See Matcher.aggregate; one path's costs go to each of paths."""
    height, width, _ = volume.shape
    for i in prange(len(directions)):
        dy, dx = directions[i]
        out = paths[i]
        for row in range(height):
            y = row if dy >= 0 else height - 1 - row
            for column in range(width):
                x = column if dx >= 0 else width - 1 - column
                py, px = y - dy, x - dx
                if py < 0 or py >= height or px < 0 or px >= width:
                    out[y, x] = volume[y, x]
                    continue
                edge = np.float32(abs(guide[y, x] - guide[py, px]) / contrast)
                penalty = max(np.float32(large) / (ONE + edge), np.float32(small))
                _step(volume[y, x], out[py, px], np.float32(small), penalty, out[y, x])
