"""World points of keypoints, from the depth map of their picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64


def lift_keypoints(
    xy: Float64, depth: NDArray[np.float32], camera: Cameras, *, edge: float
) -> tuple[Float64, NDArray[np.bool_]]:
    """Keypoints lifted by the depth between the four pixel centres around each.

    Depth is interpolated as its inverse, which on a plane is linear in the picture. A keypoint
    needs all four depths, and they may not spread over more than ``edge``: across a silhouette
    the interpolated depth would lie on neither surface.

    Args:
        xy: (N, 2), pixels; the first pixel's centre is (0.5, 0.5).
        depth: (H, W) z-depth, scene units; 0, NaN and inf mean none.
        camera: a batch of one, of the same size.
        edge: largest spread of the four depths, as a share of the depth.

    Returns:
        (N, 3) float64, world frame, scene units, and (N,) bool, which of them hold.
    """
    height, width = depth.shape
    corner = np.clip(np.floor(xy - 0.5), 0, np.maximum([width - 2, height - 2], 0)).astype(np.int64)
    # Outside the outermost centres the nearest depth holds.
    along = np.clip(xy - 0.5 - corner, 0, 1)
    x, y = corner.T
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.divide(1, depth, out=np.full(depth.shape, np.nan), where=known)
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    four = np.stack([inverse[y, x], inverse[y, right], inverse[below, x], inverse[below, right]])
    u, v = along.T
    weight = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    z = 1 / (four * weight).sum(axis=0)
    ok = (four.max(axis=0) - four.min(axis=0)) * z <= edge
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(camera.K[0]).T
    points = rays * z[:, None] @ camera.world_from_cam[0, :3, :3].T + camera.centers[0]
    return points, ok
