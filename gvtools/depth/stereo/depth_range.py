"""Between which depths a view's surfaces are sought."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import DegenerateError
from gvtools.scenes.scene import Scene, SparsePoints

Float64 = NDArray[np.float64]

# Sparse points of a view from which percentiles are taken.
ENOUGH_POINTS = 25
LOW, HIGH = 2.0, 98.0  # percentiles
MARGIN = 1.5  # on either end, as a factor of the depth
# Optical axes that meet at less than this angle do not tell where, degrees.
MEETING_ANGLE = 4.0
# Without sparse points or meeting axes: typical depth over the distance to the nearest views.
DEPTH_OF_BASELINE = 12.0
# Centres that are less than this many roundings of their coordinates apart stand at one place.
ROUNDINGS = 256
# How far the unknown range reaches on either side of the typical depth, as a factor.
UNKNOWN_NEAR, UNKNOWN_FAR = 8.0, 16.0


@dataclass(frozen=True)
class DepthRange:
    """Depths of one view, scene units.

    Attributes:
        near: where the search begins.
        far: where it ends.
        lower: lower quartile of the depths, or what stands for it.
        upper: upper quartile.
        origin: "points", "axes", "baseline" or "pictures": what it was derived from.
    """

    near: float
    far: float
    lower: float
    upper: float
    origin: str


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Sparse points of one view.

    Attributes:
        positions: (N, 3) float64, world frame, scene units.
        index: (N,) rows of the scene's points.
        points: all of the scene's points.
    """

    positions: Float64
    index: NDArray[np.int64]
    points: SparsePoints

    def seen_by(self, views: list[int]) -> NDArray[np.bool_]:
        """(len(views), N) whether each of the scene's views has each point in its tracks."""
        row = np.full(len(self.points.positions), -1)
        row[self.index] = np.arange(len(self.index))
        mine = row[self.points.point_index]
        count = 1 + max([int(self.points.view_index.max(initial=-1)), *views])
        seen = np.zeros((count, len(self.index)), bool)
        seen[self.points.view_index[mine >= 0], mine[mine >= 0]] = True
        return seen[views]


def seen_points(scene: Scene, name: str) -> SeenPoints | None:
    """The sparse points in a view's tracks; None where there are too few to go by."""
    points = scene.points
    if points is None:
        return None
    view = scene.names.index(name)
    index = np.unique(points.point_index[points.view_index == view]).astype(np.int64)
    if len(index) < ENOUGH_POINTS:
        return None
    return SeenPoints(points.positions[index], index, points)


def estimate_range(scene: Scene, name: str) -> DepthRange:
    """The depth range of a view, before its pictures are looked at.

    From the view's sparse points when it has enough of them: percentiles with a margin. Otherwise
    from the cameras: people aim at what they photograph, so it is assumed that the surfaces lie
    about where the optical axes of the views come closest to each other; and where the axes are
    parallel, that neighbouring views are a twelfth of the depth apart. Both are orders of magnitude
    and get a wide range, to be narrowed by ``range_of_depths``.
    """
    tracks = seen_points(scene, name)
    camera = scene[name].camera
    if tracks is not None:
        _, z = camera.project(tracks.positions)
        ahead = z[0][z[0] > 0]
        if len(ahead) >= ENOUGH_POINTS:
            return range_of_depths(ahead, origin="points")
    typical, origin = _meeting_depth(scene, name), "axes"
    if typical is None:
        typical, origin = _baseline_depth(scene, name), "baseline"
    return DepthRange(
        typical / UNKNOWN_NEAR, typical * UNKNOWN_FAR, typical / 1.5, typical * 1.5, origin
    )


def range_of_depths(depths: Float64, *, origin: str, margin: float = MARGIN) -> DepthRange:
    """The range that known depths of a view span.

    Args:
        depths: (N,) scene units, outliers among them.
        origin: see DepthRange.
        margin: factor by which the range reaches beyond the percentiles.
    """
    low, lower, upper, high = np.percentile(depths, [LOW, 25, 75, HIGH])
    return DepthRange(float(low / margin), float(high * margin), float(lower), float(upper), origin)


def baselines(scene: Scene, name: str) -> Float64:
    """(V,) distance from a view to each of the scene's; 0 where it drowns in the rounding."""
    centers = scene.cameras.centers
    distance = np.linalg.norm(centers - centers[scene.names.index(name)], axis=-1)
    rounding = ROUNDINGS * np.finfo(np.float64).eps * float(np.abs(centers).max())
    return np.where(distance > rounding, distance, 0.0)


def _meeting_depth(scene: Scene, name: str) -> float | None:
    """Median depth at which the view's optical axis comes closest to those of the others."""
    cameras = scene.cameras
    view = scene.names.index(name)
    centers, axes = cameras.centers, cameras.cam_from_world[:, 2, :3]
    cosine = np.clip(axes @ axes[view], -1, 1)
    gap = centers - centers[view]
    sine2 = 1 - cosine**2
    turned = (sine2 > np.sin(np.deg2rad(MEETING_ANGLE)) ** 2) & (cosine > 0)
    turned &= baselines(scene, name) > 0
    mine, theirs = gap @ axes[view], np.einsum("vj,vj->v", gap, axes)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (mine - cosine * theirs) / sine2
        other = (cosine * mine - theirs) / sine2
    met = turned & (along > 0) & (other > 0)
    if met.sum() < max(2, 0.25 * (len(cameras) - 1)):
        return None
    return float(np.median(along[met]))


def _baseline_depth(scene: Scene, name: str) -> float:
    """Typical depth when the distance to the nearest views is all there is to go by."""
    distance = baselines(scene, name)
    nearest = np.sort(distance[distance > 0])[:4]
    if not len(nearest):
        raise DegenerateError(
            f"{scene.root}: view {name} has no other view at another place among {len(scene)}; "
            "stereo needs two viewpoints; add photographs taken a step aside"
        )
    return DEPTH_OF_BASELINE * float(np.median(nearest))
