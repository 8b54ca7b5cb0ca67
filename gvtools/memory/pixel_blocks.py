"""Pixels finer than what a memory resolves: four of them become one point."""

# mypy: no-check-untyped-defs

from __future__ import annotations

import numpy as np

from gvtools.memory.compiled import compiled

SIDE = 2


@compiled()
def join_blocks(pixels, shape, largest, positions, colors, weight, spacing):
    """Each block of 2 x 2 pixels that were all lifted, and is at most ``largest`` wide, is joined.

    Args:
        pixels: (N,) int64 row-major, where the points come from, ascending.
        shape: (H, W) of the image.
        largest: side of a block, scene units.
        positions: (N, 3) float32, rearranged in place, as the others.
        colors: (N, 3) uint8.
        weight: (N,) float32.
        spacing: (N,) float32, of a pixel; a joined point keeps the mean of its pixels'.

    Returns:
        How many points are left, at the arrays' beginning, in the order of their blocks.
    """
    height, width = shape
    point = np.full((height + SIDE - 1, width + SIDE - 1), -1, np.int32)
    for i in range(len(pixels)):
        point[pixels[i] // width, pixels[i] % width] = i
    old_positions, old_colors = positions.copy(), colors.copy()
    old_weight, old_spacing = weight.copy(), spacing.copy()
    n = 0
    for row in range(0, height, SIDE):
        for col in range(0, width, SIDE):
            a, b = point[row, col], point[row, col + 1]
            c, d = point[row + 1, col], point[row + 1, col + 1]
            if a >= 0 and b >= 0 and c >= 0 and d >= 0:
                apart = (old_spacing[a] + old_spacing[b] + old_spacing[c] + old_spacing[d]) / 4
                if SIDE * apart <= largest:
                    for k in range(3):
                        positions[n, k] = (
                            old_positions[a, k] + old_positions[b, k]
                            + old_positions[c, k] + old_positions[d, k]
                        ) / 4  # fmt: skip
                        total = (
                            np.int32(old_colors[a, k]) + np.int32(old_colors[b, k])
                            + np.int32(old_colors[c, k]) + np.int32(old_colors[d, k])
                        )  # fmt: skip
                        colors[n, k] = (total + 2) // 4
                    weight[n] = (old_weight[a] + old_weight[b] + old_weight[c] + old_weight[d]) / 4
                    spacing[n] = apart
                    n += 1
                    continue
            for i in (a, b, c, d):
                if i >= 0:
                    positions[n] = old_positions[i]
                    colors[n] = old_colors[i]
                    weight[n], spacing[n] = old_weight[i], old_spacing[i]
                    n += 1
    return n
