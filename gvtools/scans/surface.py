"""Surfaces as registration compares them: thinned by cells, with features of their shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import open3d as o3d

Float64 = NDArray[np.float64]

# About so many cells hold a point of a surface, and at most so many of its points are kept.
POINTS, KNOWN = 6000, 250_000
# Fewest and most points that features are computed for.
FEWEST_FEATURES, MOST = 100, 20_000
# In cubes that hold one point: radii of normals and features; and most neighbours in these.
NORMALS, FEATURES, NEIGHBOURS = 2.0, 5.0, 100
# Unevenness is measured at so many points.
LOOKED_AT = 2000


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of a surface.

    Attributes:
        positions: (N, 3) float64.
        seen_from: (N, 3) float64, centre of a camera or scanner that saw each; None if unknown.
    """

    positions: Float64
    seen_from: Float64 | None = None


def unevenness(surface: Surface) -> float:
    """How far points are from lying on a surface: 0 on a plane, up to 1/3 if they fill a volume.

    It is the median share of the smallest eigenvalue in the covariances of neighbourhoods.

    >>> u, v = np.random.default_rng(0).random((2, 4000))
    >>> round(unevenness(Surface(np.stack([u, v, 0 * u], axis=1))), 3)
    0.0
    """
    import open3d as o3d

    rng = np.random.default_rng(0)
    positions = known(surface, rng).positions
    positions = positions - np.median(positions, axis=0)
    cell = cell_of(positions)
    cloud = cloud_of(positions).voxel_down_sample(cell)
    cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamHybrid(2.5 * cell, NEIGHBOURS))
    covariances = np.asarray(cloud.covariances)
    covariances = covariances[rng.permutation(len(covariances))[:LOOKED_AT]]
    variances = np.maximum(np.linalg.eigvalsh(covariances), 0)
    return float(np.median(variances[:, 0] / np.maximum(variances.sum(axis=1), 1e-300)))


class Features:
    """A surface's points, one for each cube of edge ``cell``, with FPFH features.

    ``outward`` turns normals away from where points were seen, or from the origin.
    """

    def __init__(self, surface: Surface, cell: float, *, outward: bool) -> None:
        import open3d as o3d

        whole = cloud_of(surface.positions)
        if surface.seen_from is not None:
            # As normals, which voxel_down_sample averages along with the points.
            whole.normals = o3d.utility.Vector3dVector(surface.seen_from)
        cloud = whole.voxel_down_sample(cell)
        self.points = np.asarray(cloud.points).copy()
        seen_from = np.asarray(cloud.normals).copy()
        self._features: o3d.pipelines.registration.Feature | None = None
        self.usable = FEWEST_FEATURES <= len(self.points) <= MOST
        if not self.usable:
            return
        Param = o3d.geometry.KDTreeSearchParamHybrid
        cloud.normals = o3d.utility.Vector3dVector()
        cloud.estimate_normals(Param(NORMALS * cell, NEIGHBOURS // 3))
        normals = np.asarray(cloud.normals)
        # Without viewpoints: a room is seen from the origin, its middle, an object from outside.
        towards = (seen_from if len(seen_from) else np.zeros(3)) - self.points
        turned = (normals * towards).sum(axis=1) < 0
        normals[turned != outward] *= -1
        cloud.normals = o3d.utility.Vector3dVector(normals)
        self._features = o3d.pipelines.registration.compute_fpfh_feature(
            cloud, Param(FEATURES * cell, NEIGHBOURS)
        )

    def matches(self, other: Features) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of points whose features are each other's nearest."""
        import open3d as o3d

        if self._features is None or other._features is None:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        pairs = np.asarray(
            o3d.pipelines.registration.correspondences_from_features(
                self._features, other._features, mutual_filter=True, mutual_consistency_ratio=0.0
            )
        )
        return pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)


def moved(surface: Surface, middle: Float64) -> Surface:
    """A surface about another origin."""
    seen = surface.seen_from
    return Surface(surface.positions - middle, None if seen is None else seen - middle)


def cell_of(positions: Float64) -> float:
    """Edge of the cells such that about POINTS of them hold a point."""
    edge = extent_of(positions) / 50
    for _ in range(8):
        cells = np.unique(np.floor(positions / edge).astype(np.int64), axis=0)
        ratio = len(cells) / min(POINTS, len(positions) / 2)
        if 0.7 < ratio < 1.4:
            break
        # The number of cells on a surface goes with 1 / edge².
        edge *= float(np.sqrt(ratio))
    return edge


def extent_of(positions: Float64) -> float:
    """The diagonal of the box between the 2 % and 98 % quantiles of the coordinates."""
    return float(np.linalg.norm(np.ptp(np.percentile(positions, [2, 98], axis=0), axis=0))) or 1.0


def known(surface: Surface, rng: np.random.Generator) -> Surface:
    """A random KNOWN of the points, or all."""
    rows, seen = rows_of(surface, KNOWN, rng), surface.seen_from
    return Surface(surface.positions[rows], None if seen is None else seen[rows])


def rows_of(surface: Surface, most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of at most so many points."""
    count = len(surface.positions)
    return rng.choice(count, most, replace=False) if count > most else np.arange(count)


def cloud_of(positions: Float64) -> o3d.geometry.PointCloud:
    """(N, 3) positions as a cloud of Open3D."""
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(positions))
