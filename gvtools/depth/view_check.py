"""Check of recorded depth by other views: where these measured free space, nothing can be.

A sensor's depth of foil, glass or dark cardboard is off by centimetres, and differs from view to
view. A point where other views measured something farther floats in front of what is there, and
hides it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.kernels import KernelSet, compiled, in_threads

# Another view agrees with a point if its depth there differs by less than AGREE of the point's, and
# looks through it if its depth there and around is greater by more than THROUGH.
AGREE, THROUGH = 0.02, 0.04
# Depth is contradicted where at least so many views look through it, and more than agree.
LEAST = 2


def contradicted(
    depth: NDArray[np.float32],
    camera: Cameras,
    others: Sequence[tuple[NDArray[np.float32], Cameras]],
) -> NDArray[np.bool_]:
    """Which pixels' depth other views contradict.

    Args:
        depth: (H, W) float32 z-depth, scene units, 0 = none.
        camera: of the depth, a batch of one.
        others: the same two of each other view, whose size may differ.

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


@compiled()
def _compare(first, last, depth, other, matrix, offset, below, above, agree, through):
    """Count per pixel of rows ``first`` to before ``last`` if another view agrees or looks through.

    In: depth (H, W) and other (H', W') z-depth, 0 = none; z matrix (u, v, 1) + offset is the point
    of a pixel in homogeneous pixels of the other view, its last coordinate the z-depth there; below
    and above are AGREE and THROUGH. ``agree`` and ``through`` (H, W) are added to.
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
            if abs(theirs - z2) < below * z2:
                agree[row, column] += 1
            elif theirs > (1 + above) * z2 and _all_beyond(other, int(y), int(x), (1 + above) * z2):
                through[row, column] += 1


@compiled()
def _all_beyond(depth, row, column, least):
    """Whether all known depth of the 3 x 3 pixels around one is greater.

    Poses are a little off: beside something thin, a view seems to look through it.
    """
    for i in range(max(row - 1, 0), min(row + 2, depth.shape[0])):
        for j in range(max(column - 1, 0), min(column + 2, depth.shape[1])):
            if depth[i, j] > 0 and depth[i, j] <= least:
                return False
    return True


def compile_check() -> None:
    """Call the kernels once."""
    side, depth = np.array([4]), np.ones((4, 4), np.float32)
    camera = Cameras(np.eye(3)[None], np.eye(4)[None], side, side, ("any",))
    contradicted(depth, camera, [(2 * depth, camera)])


KERNELS = KernelSet("check of depth", compile_check, _compare)
