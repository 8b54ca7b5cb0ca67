"""Pixels finer than what a memory resolves: four of them become one point."""

# mypy: no-check-untyped-defs

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled
from gvtools.memory.store.voxel_levels import level_of

SIDE = 2
# A block may be so many times wider along its surface than across the line of sight: slanted
# surfaces keep their points, and nothing is averaged across a step. Noise widens blocks, too.
SLANTED = 4.0


def bin_pixels(
    pixels: NDArray[np.int64],
    shape: tuple[int, int],
    largest: float,
    *,
    per_spacing: float,
    positions: NDArray[np.float32],
    colors: NDArray[np.uint8],
    weight: NDArray[np.float32],
    spacing: NDArray[np.float32],
) -> int:
    """Each block of 2 x 2 pixels that were all lifted becomes one point where it is small enough.

    Its width is that of its pixels across the line of sight; along the surface it may be SLANTED
    times as wide.

    Args:
        pixels: (N,) int64 row-major, where the points come from, ascending.
        shape: (H, W) of the image.
        largest: width of a block where voxels are the finest, scene units; it doubles with them.
        per_spacing: see VoxelLevels.
        positions: (N, 3) float32, rearranged in place, as the others.
        colors: (N, 3) uint8.
        weight: (N,) float32.
        spacing: (N,) float32, of a pixel; a binned point keeps the mean of its pixels'.

    Returns:
        How many points are left, at the arrays' beginning, in the order of their blocks.
    """
    height, width = shape
    point = np.full((height + SIDE - 1, width + SIDE - 1), -1, np.int32)
    return _bin(
        pixels, point, width, largest, per_spacing, positions.copy(), colors.copy(), weight.copy(),
        spacing.copy(), positions, colors, weight, spacing,
    )  # fmt: skip


@compiled()
def _bin(
    pixels, point, width, largest, per_spacing, old_positions, old_colors, old_weight, old_spacing,
    positions, colors, weight, spacing,
):  # fmt: skip
    for i in range(len(pixels)):
        point[pixels[i] // width, pixels[i] % width] = i
    n = 0
    for row in range(0, point.shape[0] - 1, SIDE):
        for col in range(0, point.shape[1] - 1, SIDE):
            a, b = point[row, col], point[row, col + 1]
            c, d = point[row + 1, col], point[row + 1, col + 1]
            if a >= 0 and b >= 0 and c >= 0 and d >= 0:
                widest = max(
                    _apart(old_positions, a, b),
                    _apart(old_positions, c, d),
                    _apart(old_positions, a, c),
                    _apart(old_positions, b, d),
                )
                apart = _mean(old_spacing[a], old_spacing[b], old_spacing[c], old_spacing[d])
                most = largest * (1 << level_of(apart, per_spacing))
                if SIDE * apart <= most and SIDE * widest <= SLANTED * most:
                    for k in range(3):
                        positions[n, k] = _mean(
                            old_positions[a, k], old_positions[b, k],
                            old_positions[c, k], old_positions[d, k],
                        )  # fmt: skip
                        color = _mean(
                            old_colors[a, k], old_colors[b, k], old_colors[c, k], old_colors[d, k]
                        )
                        colors[n, k] = np.uint8(color + 0.5)
                    weight[n] = _mean(old_weight[a], old_weight[b], old_weight[c], old_weight[d])
                    spacing[n] = apart
                    n += 1
                    continue
            for i in (a, b, c, d):
                if i >= 0:
                    for k in range(3):
                        positions[n, k] = old_positions[i, k]
                        colors[n, k] = old_colors[i, k]
                    weight[n], spacing[n] = old_weight[i], old_spacing[i]
                    n += 1
    return n


@compiled()
def _apart(positions, p, q):
    """The distance of two points by their rows."""
    total = 0.0
    for k in range(3):
        total += (np.float64(positions[p, k]) - np.float64(positions[q, k])) ** 2
    return np.sqrt(total)


@compiled()
def _mean(a, b, c, d):
    """In float64, where the sum of the greatest float32 has room."""
    return (np.float64(a) + np.float64(b) + np.float64(c) + np.float64(d)) / 4
