"""The scale of computed depth by sparse points or cameras: reported, refused without support."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.scenes.scene import Scene
from gvtools.similarity import ScaleFit, align_depth_scale

# Sparse points that have to fall on known depth.
MIN_POINTS = 20
# A scale farther from 1 than this is of other poses or another unit.
SUSPECT = 0.05
# Fewer sparse points on known depth, in all views together, say nothing of the scale.
MIN_POINTS_IN_ALL = 50
# Fewer centres fit each other by chance: of four at random, one set in a hundred correlates by more
# than 0.956, of three by 0.998, of two by 1.
MIN_CENTRES, MIN_CORRELATION = 4, 0.97
# So many passes of fewer views count together where their scales agree within this factor.
MIN_PASSES, PASSES_AGREE = 3, 1.35


def scale_to_points(scene: Scene, name: str, depth: NDArray[np.float32]) -> ScaleFit | None:
    """The robust scale between a view's depth and its sparse points.

    Args:
        scene: the project; its points are in its own unit.
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


@dataclass(frozen=True)
class FoundationScale:
    """How the network's unit became the scene's."""

    status: str  # "aligned", or "unsupported: ..." with the reason
    support: str  # "points" or "cameras"
    scale: float  # scene units per unit of the network (after the known cameras' own unit)
    count: int  # points, or centres

    @property
    def ok(self) -> bool:
        """Whether the scale may be used."""
        return self.status == "aligned"


@dataclass(frozen=True, eq=False)
class Pass:
    """One forward pass of the network."""

    # (h, w) z-depth by view, at the network's size, in its unit.
    depth: dict[str, NDArray[np.float32]]
    confidence: dict[str, NDArray[np.float32]]  # (h, w) in [0, 1) by view
    # (V, 3) predicted camera centres, frame of the first view, its unit.
    centres: NDArray[np.float64]
    names: tuple[str, ...]  # of the V views
    unit: float  # scene units a unit of the known cameras that the network saw; 1 without them


def fit_scale(scene: Scene, passes: Sequence[Pass]) -> FoundationScale:
    """One scale for some passes: by their sparse points, or by their cameras' centres."""
    by_points = _fit_points(scene, passes)
    # Points that fit no scale refuse the depth itself; what the centres say does not mend it.
    if by_points.ok or by_points.count >= MIN_POINTS_IN_ALL:
        return by_points
    by_cameras = _fit_cameras(scene, passes)
    if by_cameras.ok or scene.points is None:
        return by_cameras
    return by_points


def _fit_points(scene: Scene, passes: Sequence[Pass]) -> FoundationScale:
    if scene.points is None:
        return FoundationScale("unsupported: no sparse points", "points", np.nan, 0)
    pairs = [
        (measured.astype(np.float64) * part.unit, known)
        for part in passes
        for name in part.names
        for measured, known in [depth_of_points(scene, name, part.depth[name])]
    ]
    depth, reference = (np.concatenate([np.zeros(0), *side]) for side in zip(*pairs, strict=True))
    fitted = align_depth_scale(
        depth, reference, valid=depth > 0, min_support=MIN_POINTS_IN_ALL, inlier_band=0.1
    )
    return FoundationScale(fitted.status, "points", fitted.scale, fitted.support)


def _fit_cameras(scene: Scene, passes: Sequence[Pass]) -> FoundationScale:
    """The median of the passes' own fits, weighted by their views; see ``MIN_CENTRES``."""
    import torch

    from gvtools.completers.geoverse.objective import center_similarity

    scales, weights, reason = [], [], "no pass"
    for part in passes:
        known = np.concatenate([scene[name].camera.centers for name in part.names])
        fitted = center_similarity(
            torch.from_numpy(part.centres * part.unit)[None], torch.from_numpy(known)[None]
        )
        if not bool(fitted.ok[0]):
            reason = fitted.status[0]
        elif float(fitted.correlation[0]) < MIN_CORRELATION:
            reason = f"centres correlate by {float(fitted.correlation[0]):.2f}"
        else:
            scales.append(float(fitted.scale[0]))
            weights.append(len(part.names))
    if scales and max(weights) < MIN_CENTRES:
        # Each of them would fit by chance; several that agree do not.
        agree = len(scales) >= MIN_PASSES and max(scales) <= PASSES_AGREE * min(scales)
        if not agree:
            reason = f"{max(weights)} views a pass, at least {MIN_CENTRES} are needed"
            scales = []
    if not scales:
        return FoundationScale(f"unsupported: {reason}", "cameras", np.nan, 0)
    scale = float(np.median(np.repeat(scales, weights)))
    return FoundationScale("aligned", "cameras", scale, sum(weights))
