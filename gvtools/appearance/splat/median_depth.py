"""Median depth of splatted Gaussians."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.project_kernels import (
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    END,
    LEAST_ALPHA,
    OPACITY,
    X,
    Y,
)  # fmt: skip
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.appearance.splat.tile_kernels import MOST_ALPHA, TILE
from gvtools.kernels import compiled, in_threads

# The surface is the first Gaussian after which less than this share of the light is left.
HALF = 0.5


def median_depth(values: NDArray[Any], lens: Lens) -> NDArray[np.float32]:
    """(H, W) z-depth, scene units, of the Gaussian at which half of the light is stopped; else 0.

    The weighted mean of depths, which fits compare with recorded depth, is too near: faint
    Gaussians before a surface pull it forward, and nothing behind the surface balances them. On
    photographs of an object it was 1.6 % nearer than a plane sweep's depth, the median 0.3 %. The
    median is less smooth: each Gaussian has one depth.

    Args:
        values: (N, VALUES) float32 in the Gaussians' frame, see ``Splat``.
        lens: of the camera, its pose in the same frame.
    """
    shown = Splat(values, lens)
    out = np.zeros((lens.height, lens.width), np.float32)
    in_threads(
        median_tiles, len(shown.tiles), shown.tiles, shown.tiles_x, shown.offsets, shown.lists,
        shown.projected, out,
    )  # fmt: skip
    return out


@compiled(error_model="numpy")
def median_tiles(first, last, tiles, tiles_x, offsets, lists, projected, depth):
    """Write the median depth of the tiles ``tiles[first:last]``; see tile_kernels.blend_tiles.

    Args:
        first: of the rows of ``tiles``.
        last: one past the last of them.
        offsets: of the tiles' lists in ``lists``.
        lists: (pairs, 3) Gaussians of the tiles, nearest first.
        depth: (H, W), written where there is a surface.
    """
    height, width = depth.shape
    for at in range(first, last):
        tile = tiles[at]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                light = 1.0
                for k in range(offsets[tile], offsets[tile + 1]):
                    row = projected[lists[k, 0]]
                    dx, dy = x + 0.5 - row[X], y + 0.5 - row[Y]
                    q = 0.5 * (row[CONIC_XX] * dx * dx + row[CONIC_YY] * dy * dy)
                    q += row[CONIC_XY] * dx * dy
                    if q < row[END]:
                        # As in blend_tiles: falls to zero twice as fast near LEAST_ALPHA.
                        alpha = row[OPACITY] * math.exp(-q)
                        alpha = min(alpha, 2 * alpha - 2 * LEAST_ALPHA, MOST_ALPHA)
                        light *= 1 - max(alpha, 0)
                        if light < HALF:
                            depth[y, x] = row[DEPTH]
                            break
