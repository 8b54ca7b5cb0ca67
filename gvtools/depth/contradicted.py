"""Recorded depth that other views contradict: what they see through cannot be there.

A sensor's depth of foil, glass or dark cardboard is off by centimetres, and differs from view to
view. A pixel's point that other views look through, to something farther, floats in front of what
is there, and hides it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.kernels import compiled, in_threads

# Relative difference of depth up to which views agree, and from which on one sees through.
AGREE, THROUGH = 0.02, 0.04
# So many views have to see through a point, and more than agree, for it to be dropped.
LEAST = 2


def contradicted(
    depth: NDArray[np.float32],
    camera: Cameras,
    others: Sequence[tuple[NDArray[np.float32], Cameras]],
) -> NDArray[np.bool_]:
    """Which pixels other views look through.

    Args:
        depth: (H, W) z-depth, scene units, 0 = none.
        camera: of the depth, a batch of one.
        others: depth (H', W') and camera of each other view.

    Returns:
        (H, W) bool.
    """
    height, width = depth.shape
    agree, through = np.zeros((2, height, width), np.uint8)
    for other, seen_by in others:
        motion = seen_by.cam_from_world[0] @ camera.world_from_cam[0]
        matrix = seen_by.K[0] @ motion[:3, :3] @ np.linalg.inv(camera.K[0])
        in_threads(
            _compare, height, depth, other, matrix, seen_by.K[0] @ motion[:3, 3], AGREE, THROUGH,
            agree, through,
        )  # fmt: skip
    return (through >= LEAST) & (through > agree)


@compiled(error_model="numpy")
def _compare(first, last, depth, other, matrix, offset, near, far, agree, through):
    """Count per pixel of rows ``first`` to ``last`` whether another view agrees or sees through.

    In: depth (H, W); other (H', W'); matrix (3, 3) and offset (3,) carry a pixel with its depth
    into the other picture. ``agree`` and ``through`` (H, W) are added to.
    """
    height, width = other.shape
    for row in range(first, last):
        v = row + 0.5
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if not z > 0:
                continue
            u = column + 0.5
            z2 = z * (matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]) + offset[2]
            if not z2 > 0:
                continue
            x = (z * (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) + offset[0]) / z2
            y = (z * (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) + offset[1]) / z2
            if x < 0 or y < 0 or x >= width or y >= height:
                continue
            theirs = other[int(y), int(x)]
            if not theirs > 0:
                continue
            if abs(theirs - z2) < near * z2:
                agree[row, column] += 1
            elif theirs > (1 + far) * z2:
                through[row, column] += 1
