"""Whether a view's depth has the scale of the sparse points that it sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.scenes.scene import Scene
from gvtools.similarity import ScaleFit, align_depth_scale

# Sparse points that have to fall on known depth.
MIN_POINTS = 20
# A scale farther from 1 than this is of other poses or another unit.
SUSPECT = 0.05


def scale_to_points(scene: Scene, name: str, depth: NDArray[np.float32]) -> ScaleFit | None:
    """The robust scale between a view's depth and its sparse points.

    Args:
        scene: the project; its points are in its own unit.
        name: of the view.
        depth: (H, W) z-depth, scene units, 0 = none.

    Returns:
        The fit of points = scale x depth: 1 is agreement; None in a scene without sparse points.
    """
    if scene.points is None:
        return None
    measured, known = depth_of_points(scene, name, depth)
    return align_depth_scale(measured, known, valid=measured > 0, min_support=MIN_POINTS)


def depth_of_points(
    scene: Scene, name: str, depth: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The depth map's value at each sparse point of a view, and the point's own depth.

    Args:
        scene: the project, with sparse points.
        name: of the view.
        depth: (h, w) z-depth, of the view's size or another one, 0 = none.

    Returns:
        (N,) the map's, and (N,) the points', scene units.
    """
    points = scene.points
    assert points is not None
    row = scene.names.index(name)
    camera = scene.views[row].camera
    mine = points.view_index == row
    _, z = camera.project(points.positions[points.point_index[mine]])
    height, width = depth.shape
    column = np.floor(points.xy[mine, 0] * (width / int(camera.width[0]))).astype(np.int64)
    line = np.floor(points.xy[mine, 1] * (height / int(camera.height[0]))).astype(np.int64)
    inside = (column >= 0) & (column < width) & (line >= 0) & (line < height) & (z[0] > 0)
    return depth[line[inside], column[inside]], z[0][inside]


def disagrees(fit: ScaleFit | None) -> bool:
    """Whether a fit contradicts the depth: another scale, or points that fit no scale."""
    if fit is None or fit.support < MIN_POINTS:
        return False
    return not fit.ok or abs(fit.scale - 1) > SUSPECT
