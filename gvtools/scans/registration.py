"""The similarity between a scan and the photographs' points, estimated by registration.

Features of both surfaces (FPFH, R. B. Rusu et al., "Fast Point Feature Histograms for 3D
registration", ICRA 2009) are matched at several scales, first of few points, then of more. Each set
of matches gives a similarity by LO-RANSAC (pycolmap), and the best are refined by ICP with scale
(Open3D). A result that too few points support, or that is not unique, is refused. The search is
limited by the number of points with features, not by time: it is the same on a busy machine.

A cell is a cube such that about 6,000 of them hold the photographs' points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import DegenerateError, OptionError
from gvtools.scenes.calibration import load_matrix

if TYPE_CHECKING:
    import open3d as o3d

Float64 = NDArray[np.float64]

ESTIMATE, IDENTITY = "estimate", "identity"
FORMS = (
    f"{ESTIMATE}, {IDENTITY}, a text file with a 3x4 or 4x4 matrix, or its 12 or 16 numbers row by "
    "row with commas between"
)
# Tolerance of RᵀR = I for a given rotation R.
ORTHONORMAL = 1e-3


# About so many cells hold a point of a surface, and at most so many of its points are kept.
POINTS, KNOWN = 6000, 250_000
# What is so many extents away from the median is a stray value, not a surface.
FAR_OUT = 1000
# Fewest and most points that features are computed for.
FEWEST_FEATURES, MOST = 100, 20_000
# In cubes that hold one point: radii of normals and features; and most neighbours in these.
NORMALS, FEATURES, NEIGHBOURS = 2.0, 5.0, 100
# Unevenness is measured at so many points.
LOOKED_AT = 2000
# Surfaces with fewer points are refused.
FEWEST = 300
# ICP and fitness seek the nearest neighbours of at most so many points.
COUNTED = 8000
# Features are computed for one point in each cube of so many cells a side, coarse ones first. Finer
# ones cost more and found less: a kitchen in a scan of four times its extent has 38 true matches at
# 2, and at 1 more points than can be matched.
LEVELS = (3.0, 2.0)
# Limit of the scan's points with features in the whole search; 10,000 take about a second of CPU
# time.
BUDGET = 200_000
# A scan whose ``unevenness`` is larger lies on no surface: 0.27 in a cloud of noise, 0.08 in a scan
# of a kitchen.
VOLUME = 0.2
# RANSAC's inlier threshold, in cubes of a level; greatest correspondence distances of ICP, step by
# step, in cells.
MATCH, STEPS = 1.5, (4.0, 2.0, 1.0, 0.5)
# A point supports a placement if the other surface has a point within this, in cells.
TOLERANCE = 1 / 3
# Iterations of ICP at a distance, and for the placement that is returned.
ROUGH_STEPS, POLISHING = 30, 200
# Factors of the ratio of extents that are tried as scales, the likeliest first.
SCALES = tuple(2.0 ** (k / 2) for k in (0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5))
# Scales that are tried first in metric scenes: scans in metres and in millimetres.
METRIC = (1.0, 0.001)
# A scale that differs by less from one of them becomes it, if this share of the support stays.
NEAR, AS_WELL = 0.02, 0.98
# Iterations of RANSAC: if one match in thirty is right, one sample of three in 27,000 is.
TRIALS = 30_000
# At a fitness of at least this no further scale is tried.
CLEAR = 0.8
# Number of placements by features of a level that are refined by ICP.
REFINED = 4
# The result is refused if one more than APART cells away has at least this share of its fitness.
RIVAL, APART = 0.85, 3.0


@dataclass(frozen=True, eq=False)
class Placement:
    """A similarity, and how well it is supported."""

    # (4, 4) float64, scale times rotation, and translation, for the file's coordinates
    world_from_scan: NDArray[np.float64]
    how: str  # "given", "as it is" (an estimate that left the scan where it was) or "estimated"
    # share of the photographs' points that have a point of the scan within ``tolerance``;
    # None where nothing judged it, like the next ones
    fitness: float | None = None
    # share of the scan's points that have one of the photographs'
    scan_fitness: float | None = None
    rmse: float | None = None  # of the distances within ``tolerance``, scene units
    tolerance: float | None = None  # scene units

    @property
    def scale(self) -> float:
        """Scene units per unit of the scan."""
        return float(np.cbrt(np.linalg.det(self.world_from_scan[:3, :3])))

    def apply(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) points of the file's frame in the world."""
        return positions @ self.world_from_scan[:3, :3].T + self.world_from_scan[:3, 3]

    def summary(self) -> str:
        """A line of text for the user."""
        text = f"{self.how}, scale {self.scale:.6g}"
        if self.fitness is None:
            return text
        return (
            f"{text}, fitness {self.fitness:.2f} of the photographs' and {self.scan_fitness:.2f} "
            f"of the scan's points within {self.tolerance:.3g} (rmse {self.rmse:.2g})"
        )

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        values = {**vars(self), "world_from_scan": self.world_from_scan.tolist()}
        first = {name: values.pop(name) for name in ("world_from_scan", "how")}
        return {**first, "scale": self.scale, **values}


def given_placement(text: str) -> Placement | None:
    """The placement that a text gives, see FORMS; None for "estimate".

    >>> round(given_placement("2,0,0,5, 0,2,0,0, 0,0,2,0").scale, 6)
    2.0
    """
    if text == ESTIMATE:
        return None
    if text == IDENTITY:
        return Placement(np.eye(4), "given")
    try:
        rows = np.reshape([float(part) for part in text.split(",")], (-1, 4))
    except ValueError:
        rows = load_matrix(Path(text), (3, 4), (4, 4)) if Path(text).is_file() else np.zeros((0, 4))
    whole = len(rows) == 3 or (len(rows) == 4 and np.array_equal(rows[3], [0, 0, 0, 1]))
    matrix = np.vstack([rows[:3], [0, 0, 0, 1]]) if whole else np.zeros((4, 4))
    scale = np.cbrt(np.linalg.det(matrix[:3, :3])) if np.isfinite(matrix).all() else np.nan
    turn = matrix[:3, :3] / scale if scale > 0 else np.full((3, 3), np.nan)
    if not np.allclose(turn.T @ turn, np.eye(3), atol=ORTHONORMAL):
        raise OptionError(
            f"scan.placement {text!r}: no similarity; expected {FORMS}, of scale x rotation, no "
            "mirror"
        )
    return Placement(matrix, "given")


def register(
    scan: Surface,
    photographed: Surface,
    *,
    least: float,
    metric: bool,
    seed: int = 0,
    given: Placement | None = None,
) -> Placement:
    """The similarity from a scan's frame to the photographs' world.

    ``least`` is the smallest fitness that is accepted, 0 to 1; in a ``metric`` world, whose unit is
    the metre, METRIC scales are tried first. A ``given`` one is judged alone.
    """
    for name, surface in (("scan", scan), ("photographs", photographed)):
        if len(surface.positions) < FEWEST:
            raise DegenerateError(
                f"{len(surface.positions)} points of the {name} to place the scan by; expected "
                f"{FEWEST}; give its placement"
            )
    task = _Task(scan, photographed, seed=seed)
    if given is not None:
        judged = task.judged(task.of_world(given.world_from_scan), given.how)
        return replace(judged, world_from_scan=given.world_from_scan)
    there = task.judged(task.of_world(np.eye(4)), "as it is")
    if _support(there) >= least:
        return there
    if (share := unevenness(scan)) > VOLUME:
        raise DegenerateError(
            "the scan's points lie on no surface (least share of the variance in a neighbourhood: "
            f"{share:.2f}, expected less than {VOLUME}); give its placement if they do"
        )
    found = task.candidates(METRIC, least=least) if metric else []
    if not found or _support(found[0]) < least:
        found = sorted([*found, *task.candidates(task.scales(), least=least)], key=_support)[::-1]
    if not found or _support(found[0]) < least:
        why = "none was found"
        if found:
            why = (
                f"the best fits {_support(found[0]):.0%} of the points within "
                f"{task.tolerance:.3g}, expected {least:.0%}"
            )
        raise DegenerateError(
            f"no placement of the scan is supported: {why}; give its placement, or views that see "
            "more of what was scanned"
        )
    best = task.polished(found[0])
    if metric:
        best = task.in_units(best)
    for other in found[1:]:
        if _support(other) > RIVAL * _support(best) and task.apart(best, other) > APART * task.cell:
            raise DegenerateError(
                f"two placements of the scan fit about alike ({_support(best):.2f} and "
                f"{_support(other):.2f}, {task.apart(best, other):.3g} apart); give its placement"
            )
    return best


def _support(placement: Placement) -> float:
    """The larger of both fitnesses: the one surface may extend far beyond the other."""
    assert placement.fitness is not None and placement.scan_fitness is not None
    return max(placement.fitness, placement.scan_fitness)


class _Task:
    """Both surfaces in local frames, each around its own median; ``cell`` is in scene units."""

    def __init__(self, scan: Surface, photographed: Surface, *, seed: int) -> None:
        from scipy.spatial import KDTree

        self.seed = seed
        rng = np.random.default_rng(seed)
        scan, photographed = subsample(scan, rng), subsample(photographed, rng)
        self.scan_middle = np.median(scan.positions, axis=0)
        self.middle = np.median(photographed.positions, axis=0)
        self.scan = shift(scan, self.scan_middle)
        self.target = shift(photographed, self.middle)
        self.cell = cell_of(self.target.positions)
        self.tolerance = TOLERANCE * self.cell
        self.source_sample = self.scan.positions[rows_of(self.scan, COUNTED, rng)]
        self.target_sample = self.target.positions[rows_of(self.target, COUNTED, rng)]
        self._scan_tree = KDTree(self.scan.positions)
        self._target_tree = KDTree(self.target.positions)
        self._targets = {
            level: SurfaceFeatures(self.target, level * self.cell, outward=False)
            for level in LEVELS
        }
        self._left = BUDGET

    def of_world(self, world_from_scan: Float64) -> Float64:
        """A world_from_scan (4, 4) as a placement between the local frames."""
        local = world_from_scan.copy()
        local[:3, 3] += world_from_scan[:3, :3] @ self.scan_middle - self.middle
        return local

    def scales(self) -> tuple[float, ...]:
        """Scales to try, world units per unit of the scan."""
        ratio = extent_of(self.target.positions) / extent_of(self.scan.positions)
        return tuple(ratio * scale for scale in SCALES)

    def candidates(self, scales: tuple[float, ...], *, least: float) -> list[Placement]:
        """The best placements by features at some scales, refined by ICP, the best first.

        Finer levels are tried only while the support is below ``least``.
        """
        found: list[Placement] = []
        for level in LEVELS:
            rough: list[tuple[float, Float64]] = []
            for scale in scales:
                for outward in (False, True) if self.scan.seen_from is None else (False,):
                    placed = self._by_features(scale, level, outward=outward)
                    if placed is None:
                        continue
                    fitness = max(self._fitness(placed, self.cell)[:2])
                    if fitness <= CLEAR:
                        rough.append((fitness, placed))
                        continue
                    # Fitness within a whole cell is high by chance: only that after ICP counts.
                    found.append(self._estimated(placed))
                    if _support(found[-1]) >= CLEAR:
                        return sorted(found, key=_support, reverse=True)
            rough.sort(key=lambda entry: -entry[0])
            found += [self._estimated(placed) for _, placed in rough[:REFINED]]
            found.sort(key=_support, reverse=True)
            if found and _support(found[0]) >= least:
                break
        return found

    def _estimated(self, placed: Float64) -> Placement:
        return self.judged(self._refined(placed), "estimated")

    def _by_features(self, scale: float, level: float, *, outward: bool) -> Float64 | None:
        """A placement by matched features with about this scale; None if none is found."""
        from gvtools.colmap import pycolmap

        if self._left <= 0:
            return None
        target = self._targets[level]
        source = SurfaceFeatures(self.scan, level * self.cell / scale, outward=outward)
        if not source.usable:
            return None
        self._left -= len(source.points)
        ours, theirs = source.matches(target)
        if len(ours) < 10:
            return None
        options = pycolmap.RANSACOptions()
        options.max_error = MATCH * level * self.cell
        options.random_seed = self.seed
        options.max_num_trials = TRIALS
        fit: Any = pycolmap.estimate_sim3d_robust(
            source.points[ours], target.points[theirs], options
        )
        if fit is None:
            return None
        similarity = fit["tgt_from_src"]
        if not 0.5 < similarity.scale / scale < 2:
            return None
        return np.vstack([similarity.matrix(), [0, 0, 0, 1]])

    def polished(self, placement: Placement) -> Placement:
        """A placement after more iterations of ICP, in which scale converges slowly."""
        local = self.of_world(placement.world_from_scan)
        local = self._refined(local, polish=True)
        return self.judged(local, placement.how)

    def in_units(self, placement: Placement) -> Placement:
        """A placement at exactly one of METRIC, if its scale is near that and the support stays."""
        unit = min(METRIC, key=lambda unit: abs(np.log(placement.scale / unit)))
        if abs(placement.scale / unit - 1) > NEAR:
            return placement
        local = self.of_world(placement.world_from_scan)
        # Scaled about the middle of the photographs' points.
        middle = np.linalg.inv(local)[:3, 3]
        local[:3, :3] *= unit / placement.scale
        local[:3, 3] = -local[:3, :3] @ middle
        local = self._refined(local, polish=True, scaled=False)
        exact = self.judged(local, placement.how)
        return exact if _support(exact) >= AS_WELL * _support(placement) else placement

    def _refined(self, placed: Float64, *, polish: bool = False, scaled: bool = True) -> Float64:
        """After ICP, with scale or without, at ever smaller distances, to ``polish`` the last."""
        from gvtools.o3d import o3d

        registration = o3d.pipelines.registration
        method = registration.TransformationEstimationPointToPoint(with_scaling=scaled)
        # From the photographs to the scan: the scan is mostly the larger surface, so each of the
        # photographs' points has a neighbour there, but not the other way round.
        inverse = np.linalg.inv(placed)
        scale = float(np.cbrt(np.linalg.det(placed[:3, :3])))
        source, target = cloud_of(self.target_sample), cloud_of(self.scan.positions)
        reach, steps = ((STEPS[-1], TOLERANCE), POLISHING) if polish else (STEPS, ROUGH_STEPS)
        ends = registration.ICPConvergenceCriteria(1e-9, 1e-9, steps)
        for step in reach:
            result = registration.registration_icp(
                source, target, step * self.cell / scale, inverse, method, ends
            )
            inverse = np.asarray(result.transformation)
        return np.linalg.inv(inverse)

    def judged(self, placed: Float64, how: str) -> Placement:
        """A placement in world coordinates with its fitness."""
        fitness, scan_fitness, rmse = self._fitness(placed, self.tolerance)
        world = placed.copy()
        world[:3, 3] += self.middle - placed[:3, :3] @ self.scan_middle
        return Placement(world, how, fitness, scan_fitness, rmse, self.tolerance)

    def _fitness(self, placed: Float64, tolerance: float) -> tuple[float, float, float]:
        """Shares of the photographs' and of the scan's points that fit, and the former's RMSE."""
        scale = float(np.cbrt(np.linalg.det(placed[:3, :3])))
        inverse = np.linalg.inv(placed)
        back = self.target_sample @ inverse[:3, :3].T + inverse[:3, 3]
        near = scale * self._scan_tree.query(back, workers=-1)[0]
        inside = near <= tolerance
        rmse = float(np.sqrt((near[inside] ** 2).mean())) if inside.any() else 0.0
        moved = self.source_sample @ placed[:3, :3].T + placed[:3, 3]
        share = float((self._target_tree.query(moved, workers=-1)[0] <= tolerance).mean())
        return float(inside.mean()), share, rmse

    def apart(self, one: Placement, other: Placement) -> float:
        """Median distance between the scan's points in two placements, scene units."""
        points = self.source_sample + self.scan_middle
        return float(np.median(np.linalg.norm(one.apply(points) - other.apply(points), axis=1)))


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of a surface."""

    positions: Float64  # (N, 3) float64
    # (N, 3) float64, centre of a camera or scanner that saw each; None if unknown
    seen_from: Float64 | None = None


def unevenness(surface: Surface) -> float:
    """How far points are from lying on a surface: 0 on a plane, up to 1/3 if they fill a volume.

    It is the median share of the smallest eigenvalue in the covariances of neighbourhoods.

    >>> u, v = np.random.default_rng(0).random((2, 4000))
    >>> round(unevenness(Surface(np.stack([u, v, 0 * u], axis=1))), 3)
    0.0
    """
    from gvtools.o3d import o3d

    rng = np.random.default_rng(0)
    positions = subsample(surface, rng).positions
    positions = positions - np.median(positions, axis=0)
    cell = cell_of(positions)
    cloud = cloud_of(positions).voxel_down_sample(cell)
    cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamHybrid(2.5 * cell, NEIGHBOURS))
    covariances = np.asarray(cloud.covariances)
    covariances = covariances[rng.permutation(len(covariances))[:LOOKED_AT]]
    variances = np.maximum(np.linalg.eigvalsh(covariances), 0)
    return float(np.median(variances[:, 0] / np.maximum(variances.sum(axis=1), 1e-300)))


class SurfaceFeatures:
    """A surface's points, one for each cube of edge ``cell``, with FPFH features.

    ``outward`` turns normals away from where points were seen, or from the origin.
    """

    def __init__(self, surface: Surface, cell: float, *, outward: bool) -> None:
        from gvtools.o3d import o3d

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

    def matches(self, other: SurfaceFeatures) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of points whose features are each other's nearest."""
        from gvtools.o3d import o3d

        if self._features is None or other._features is None:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        pairs = np.asarray(
            o3d.pipelines.registration.correspondences_from_features(
                self._features, other._features, mutual_filter=True, mutual_consistency_ratio=0.0
            )
        )
        return pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)


def shift(surface: Surface, middle: Float64) -> Surface:
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


def subsample(surface: Surface, rng: np.random.Generator) -> Surface:
    """A random KNOWN of the points, or all, but those that lie FAR_OUT extents away."""
    rows, seen = rows_of(surface, KNOWN, rng), surface.seen_from
    away = np.abs(surface.positions[rows] - np.median(surface.positions, axis=0)).max(axis=1)
    rows = rows[away < FAR_OUT * extent_of(surface.positions)]
    return Surface(surface.positions[rows], None if seen is None else seen[rows])


def rows_of(surface: Surface, most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of at most so many points."""
    count = len(surface.positions)
    return rng.choice(count, most, replace=False) if count > most else np.arange(count)


def cloud_of(positions: Float64) -> o3d.geometry.PointCloud:
    """(N, 3) positions as a cloud of Open3D."""
    from gvtools.o3d import o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(positions))
