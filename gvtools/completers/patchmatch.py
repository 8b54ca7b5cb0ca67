"""PatchMatch over several source images, restricted to patches of compatible depth.

The nearest-neighbour field by propagation and random search is that of Barnes et al.,
"PatchMatch: a randomized correspondence algorithm for structural image editing", SIGGRAPH 2009;
the voting that rebuilds colours from overlapping patches that of Wexler, Shechtman and Irani,
"Space-time completion of video", PAMI 2007. Added here: a target patch compares only pixels on the
surface of its centre, and its source must lie at a similar depth.
"""

from __future__ import annotations

import math

import numba
import numpy as np

RADIUS = 3
# Relative difference of inverse depth within which pixels of a patch are on one surface.
SURFACE = 0.05
# Sources nearer or farther than this factor show texture at another scale.
DEPTH_FACTOR = 1.5


@numba.njit(cache=True)
def _draw(state):
    """The next number of an xorshift generator in [0, 1); ``state`` holds one uint64."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return (x >> np.uint64(11)) / 9007199254740992.0


@numba.njit(cache=True)
def _cost(rgb, inverse, certainty, sources, depths, y, x, s, sy, sx, limit):
    """Mean squared colour difference of two patches, given up above ``limit``."""
    height, width = inverse.shape
    here = inverse[y, x]
    there = depths[s, sy, sx]
    cost = 0.0
    if there > 0:
        apart = math.log(there / here)
        if abs(apart) > math.log(DEPTH_FACTOR):
            return np.inf
        cost = 0.02 * apart * apart
    total = 0.0
    weights = 0.0
    ceiling = (limit - cost) * (2 * RADIUS + 1) ** 2
    for dy in range(-RADIUS, RADIUS + 1):
        ty = y + dy
        if ty < 0 or ty >= height:
            continue
        for dx in range(-RADIUS, RADIUS + 1):
            tx = x + dx
            if tx < 0 or tx >= width or inverse[ty, tx] == 0:
                continue
            if abs(inverse[ty, tx] - here) > SURFACE * here:
                continue
            weight = certainty[ty, tx]
            a = rgb[ty, tx, 0] - sources[s, sy + dy, sx + dx, 0]
            b = rgb[ty, tx, 1] - sources[s, sy + dy, sx + dx, 1]
            c = rgb[ty, tx, 2] - sources[s, sy + dy, sx + dx, 2]
            total += weight * (a * a + b * b + c * c)
            weights += weight
        if total > ceiling:
            return np.inf
    return cost + total / max(weights, 1e-9)


@numba.njit(cache=True)
def _consider(rgb, inverse, certainty, sources, depths, eligible, field, cost, m, y, x, s, sy, sx):
    """Take the source (s, sy, sx) for domain pixel m when it is allowed and better."""
    if sy < 0 or sy >= eligible.shape[1] or sx < 0 or sx >= eligible.shape[2]:
        return
    if not eligible[s, sy, sx]:
        return
    value = _cost(rgb, inverse, certainty, sources, depths, y, x, s, sy, sx, cost[m])
    if value < cost[m]:
        cost[m] = value
        field[m, 0], field[m, 1], field[m, 2] = s, sy, sx


@numba.njit(cache=True)
def search(
    rgb,
    inverse,
    certainty,
    sources,
    depths,
    eligible,
    choices,
    domain,
    row_of,
    field,
    state,
    passes,
):
    """Improve the field in place; returns the cost of each domain pixel.

    Args:
        rgb: (H, W, 3) the current estimate.
        inverse: (H, W) inverse depth.
        certainty: (H, W), 1 where the colour is known, less where it is being synthesised.
        sources: (S, Hs, Ws, 3) images to copy from.
        depths: (S, Hs, Ws) their inverse depth, 0 = unknown.
        eligible: (S, Hs, Ws) bool, centres of patches that may be copied.
        choices: (E,) flat indices of the eligible centres.
        domain: (M,) flat indices of the pixels to match, ascending.
        row_of: (H, W) row in the domain, -1 elsewhere.
        field: (M, 3) int32 source, row, column.
        state: (1,) uint64, the random state.
        passes: sweeps, forth and back by turns.
    """
    height, width = inverse.shape
    tall, wide = eligible.shape[1], eligible.shape[2]
    cost = np.full(len(domain), np.inf)
    for m in range(len(domain)):
        y, x = domain[m] // width, domain[m] % width
        s, sy, sx = field[m]
        if eligible[s, sy, sx]:
            cost[m] = _cost(rgb, inverse, certainty, sources, depths, y, x, s, sy, sx, np.inf)
    for turn in range(passes):
        way = 1 if turn % 2 == 0 else -1
        for step in range(len(domain)):
            m = step if way == 1 else len(domain) - 1 - step
            y, x = domain[m] // width, domain[m] % width
            for axis in range(2):
                y1, x1 = (y, x - way) if axis == 0 else (y - way, x)
                if 0 <= y1 < height and 0 <= x1 < width and row_of[y1, x1] >= 0:
                    n = row_of[y1, x1]
                    _consider(
                        rgb, inverse, certainty, sources, depths, eligible, field, cost, m, y, x,
                        field[n, 0], field[n, 1] + y - y1, field[n, 2] + x - x1,
                    )  # fmt: skip
            pick = choices[int(_draw(state) * len(choices))]
            _consider(rgb, inverse, certainty, sources, depths, eligible, field, cost, m, y, x,
                      pick // (tall * wide), pick // wide % tall, pick % wide)  # fmt: skip
            reach = max(tall, wide) // 4
            while reach >= 1:
                sy = field[m, 1] + int((2 * _draw(state) - 1) * reach)
                sx = field[m, 2] + int((2 * _draw(state) - 1) * reach)
                _consider(rgb, inverse, certainty, sources, depths, eligible, field, cost, m, y, x,
                          field[m, 0], sy, sx)  # fmt: skip
                reach //= 3
    return cost


@numba.njit(cache=True)
def vote(rgb, inverse, certainty, sources, domain, row_of, field, cost, sharpness):
    """(H, W, 3): each unknown pixel from the patches of its surface that cover it."""
    height, width = inverse.shape
    result = rgb.copy()
    for m in range(len(domain)):
        y, x = domain[m] // width, domain[m] % width
        if certainty[y, x] >= 1:
            continue
        here = inverse[y, x]
        # Weights are relative to the best covering patch, so that exp cannot underflow everywhere.
        best = np.inf
        for turn in range(2):
            total = red = green = blue = 0.0
            for dy in range(-RADIUS, RADIUS + 1):
                for dx in range(-RADIUS, RADIUS + 1):
                    y1, x1 = y + dy, x + dx
                    if y1 < 0 or y1 >= height or x1 < 0 or x1 >= width:
                        continue
                    n = row_of[y1, x1]
                    if n < 0 or cost[n] == np.inf:
                        continue
                    if abs(inverse[y1, x1] - here) > SURFACE * here:
                        continue
                    if turn == 0:
                        best = min(best, cost[n])
                        continue
                    weight = math.exp(-(cost[n] - best) / sharpness - 0.2 * (dy * dy + dx * dx))
                    weight *= certainty[y1, x1]
                    s, sy, sx = field[n, 0], field[n, 1] - dy, field[n, 2] - dx
                    total += weight
                    red += weight * sources[s, sy, sx, 0]
                    green += weight * sources[s, sy, sx, 1]
                    blue += weight * sources[s, sy, sx, 2]
            if turn == 1 and total > 0:
                result[y, x, 0] = red / total
                result[y, x, 1] = green / total
                result[y, x, 2] = blue / total
    return result
