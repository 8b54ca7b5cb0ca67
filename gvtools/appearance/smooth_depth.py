"""Surfaces without texture: where photographs say nothing of depth, it should bend little.

Inverse depth of a plane is linear in the picture, so what is made small is its second difference
from pixel to pixel, less so where the photograph has edges, at which surfaces end.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled

# Inverse depth, in shares of its median, may bend by so much before the loss grows more slowly:
# from there on linearly, before as its square.
SOFT = 0.002
# Where a colour from 0 to 1 changes by 1 / EDGE, the loss counts 37 %.
EDGE = 10.0
# Pixels below this alpha have no surface.
LEAST_ALPHA = 0.5


def add_bending(
    image: NDArray[np.float32],
    target: NDArray[np.float32],
    gradient: NDArray[np.float32],
    *,
    weight: float,
) -> None:
    """Add the gradient of the bending of surfaces, summed over the picture, to (5, H, W).

    Args:
        image: (5, H, W), see ``Splat``; its last two channels get a gradient.
        target: (3, H, W) the photograph, 0 to 1.
    """
    some = image[3:, ::4, ::4]
    solid = some[1] > LEAST_ALPHA
    if solid.any():
        median = np.median(some[0][solid] / some[1][solid])
        inverse = np.empty_like(image[4])
        pull = np.empty_like(inverse)
        bending_gradient(image, target, np.float32(median), np.float32(weight), inverse, pull,
                         gradient)  # fmt: skip


@compiled()
def bending_gradient(image, target, median, weight, inverse, pull, gradient):
    """See ``add_bending``.

    Args:
        median: depth, scene units.
        inverse: (H, W), overwritten.
        pull: (H, W), overwritten.
    """
    zero, one, two, soft = np.float32(0), np.float32(1), np.float32(2), np.float32(1 / SOFT)
    edge = np.float32(EDGE / 3)
    least = np.float32(LEAST_ALPHA)
    height, width = inverse.shape
    for y in range(height):
        for x in range(width):
            a = image[4, y, x]
            inverse[y, x] = median * a / image[3, y, x] if a > least else zero
    pull[:] = zero
    for dy, dx in ((0, 1), (1, 0)):
        for y in range(dy, height - dy):
            for x in range(dx, width - dx):
                here = inverse[y, x]
                before, after = inverse[y - dy, x - dx], inverse[y + dy, x + dx]
                if before > 0 and here > 0 and after > 0:
                    change = zero
                    for c in range(3):
                        middle = target[c, y, x]
                        change += abs(target[c, y - dy, x - dx] - middle)
                        change += abs(target[c, y + dy, x + dx] - middle)
                    bend = (before - two * here + after) * soft
                    g = min(max(bend, -one), one) * math.exp(-edge * change)
                    pull[y - dy, x - dx] += g
                    pull[y, x] -= two * g
                    pull[y + dy, x + dx] += g
    for y in range(height):
        for x in range(width):
            if inverse[y, x] > 0:
                # Inverse depth is median alpha / (depth alpha).
                g = weight * pull[y, x] * inverse[y, x]
                gradient[3, y, x] -= g / image[3, y, x]
                gradient[4, y, x] += g / image[4, y, x]
