"""Geometry of a view and its sources: warps, depth ranges, the choice of sources, planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64
from gvtools.errors import DegenerateError
from gvtools.scenes.scene import Scene, SparsePoints
from gvtools.view_selection import in_view

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

# Parallax at which matching still works and depth is well determined, degrees; the fall towards
# less (depth unsure) and towards more (appearance differs). MVSNet (arXiv:1804.02505, section 4.1)
# weighs sparse points likewise, with 5, 1 and 10.
BEST_ANGLE, BELOW, ABOVE = 7.0, 3.0, 8.0
# Sources that stand closer together than this share of their baseline show much the same.
APART = 0.4
# A view that shares less than this share of the reference's points is no source.
LEAST_OVERLAP = 0.15
SAMPLES_ACROSS = 10
SAMPLE_DEPTHS = 4
FEWEST, MOST = 8, 256


@dataclass(frozen=True, eq=False)
class Warps:
    """Warps from one reference view into S source views.

    The reference pixel p = (u, v, 1) at inverse depth w lies at ``matrix @ p + w * offset`` in a
    source (homogeneous pixels; the first pixel's centre is (0.5, 0.5)). On a plane of space w is
    affine in u and v, so this is the plane's homography.
    """

    matrix: Float64  # (S, 3, 3) float64, K_s R K_r⁻¹
    offset: Float64  # (S, 3) float64, K_s t, pixels x scene units

    def project(self, xy: Float64, inverse_depth: Float64) -> tuple[Float64, Float64]:
        """Where reference pixels (N, 2) at inverse depths (N,) lie in the sources.

        (S, N, 2) pixels, and (S, N) the source's depth over the reference's (<= 0: behind).
        """
        xy = np.asarray(xy, np.float64)
        homogeneous = np.concatenate([xy, np.ones_like(xy[:, :1])], axis=1)
        moved = np.einsum("sij,nj->sni", self.matrix, homogeneous)
        moved += np.asarray(inverse_depth)[None, :, None] * self.offset[:, None]
        z = moved[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return moved[..., :2] / z[..., None], z


def relative_warps(reference: Cameras, sources: Cameras) -> Warps:
    """The warps from ``reference`` (a batch of one) into ``sources``."""
    relative = sources.cam_from_world @ reference.world_from_cam[0]
    matrix = sources.K @ relative[:, :3, :3] @ np.linalg.inv(reference.K[0])
    offset = np.einsum("sij,sj->si", sources.K, relative[:, :3, 3])
    return Warps(matrix, offset)


def pixel_grid(camera: Cameras, across: int) -> Float64:
    """(N, 2) pixels spread evenly over the camera's image, ``across`` columns."""
    width, height = float(camera.width[0]), float(camera.height[0])
    down = max(2, round(across * height / width))
    x = (np.arange(across) + 0.5) * width / across
    y = (np.arange(down) + 0.5) * height / down
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def disparity_rate(
    reference: Cameras, sources: Cameras, near: float, *, far: float
) -> NDArray[np.float64]:
    """How far a pixel moves in each source from ``far`` to ``near``, over the inverse depths' gap.

    (S,) pixels x scene units: the median over the pixels that both depths keep in the source; 0
    where there are too few. ``far`` may be infinite.
    """
    warps = relative_warps(reference, sources)
    xy = pixel_grid(reference, 12)
    ends = [warps.project(xy, np.full(len(xy), 1 / depth)) for depth in (near, far)]
    size = np.stack([sources.width, sources.height], axis=-1)[:, None]
    with np.errstate(invalid="ignore"):
        inside = [((p > 0) & (p < size)).all(-1) & (z > 0) for p, z in ends]
        moved = np.linalg.norm(ends[0][0] - ends[1][0], axis=-1) / (1 / near - 1 / far)
    rate = np.zeros(len(sources))
    for i in range(len(sources)):
        # Where the near end leaves the picture, the far end alone still tells the rate's order.
        for kept in (inside[0] & inside[1], inside[1], np.isfinite(moved[i])):
            chosen = kept[i] if kept.ndim == 2 else kept
            if chosen.sum() >= 4:
                rate[i] = np.median(moved[i][chosen & np.isfinite(moved[i])])
                break
    return rate


@dataclass(frozen=True)
class DepthRange:
    """Depths of one view, scene units."""

    near: float  # where the search begins
    far: float  # where it ends
    lower: float  # lower quartile of the depths, or what stands for it
    upper: float  # upper quartile
    origin: str  # "points", "axes", "baseline" or "pictures": what it was derived from


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Sparse points of one view."""

    positions: Float64  # (N, 3) float64, world frame, scene units
    index: NDArray[np.int64]  # (N,) rows of the scene's points
    points: SparsePoints  # all of the scene's points

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


def range_of_depths(depths: Float64, *, origin: str) -> DepthRange:
    """The range that known depths (N,) of a view span, outliers among them, times a margin."""
    low, lower, upper, high = np.percentile(depths, [LOW, 25, 75, HIGH])
    return DepthRange(float(low / MARGIN), float(high * MARGIN), float(lower), float(upper), origin)


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


def choose_sources(
    scene: Scene, name: str, candidates: tuple[str, ...], *, count: int, depths: DepthRange
) -> tuple[str, ...]:
    """Names of the best source views among candidates for a reference view, best first.

    Each candidate is rated by the points of the reference that it sees too, each weighted by its
    parallax: sparse points with their tracks when the reference has enough of them, else points
    spread over its frustum inside the depth range. Candidates close to a chosen one count less, and
    those at the reference's own place are none.
    """
    others = tuple(candidate for candidate in candidates if candidate != name)
    if not others:
        return ()
    views = {view_name: i for i, view_name in enumerate(scene.names)}
    rows = [views[other] for other in others]
    cameras = scene.cameras
    reference, sources = cameras[views[name]], cameras[rows]
    tracks = seen_points(scene, name)
    points = _frustum_points(reference, depths) if tracks is None else tracks.positions
    shared = in_view(sources, points)
    if tracks is not None:
        tracked = tracks.seen_by(rows)
        # A track that misses a view may just be short; enough tracks are taken at their word.
        enough = tracked.sum(1) >= 20
        shared[enough] = tracked[enough]
    angle = parallax(reference.centers[0], sources.centers, points)
    spread = np.where(angle < BEST_ANGLE, BELOW, ABOVE)
    weight = np.exp(-((angle - BEST_ANGLE) ** 2) / (2 * spread**2)) * shared
    turned = reference.cam_from_world[0, 2, :3] @ sources.cam_from_world[:, 2, :3].T
    score = weight.mean(1) * (turned > np.cos(np.deg2rad(60)))
    score *= shared.mean(1) >= LEAST_OVERLAP
    baseline = baselines(scene, name)[rows]
    score *= baseline > 0
    baseline = np.where(baseline > 0, baseline, np.inf)
    chosen: list[str] = []
    while len(chosen) < count and score.max() > 0:
        best = int(np.argmax(score))
        chosen.append(others[best])
        gap = np.linalg.norm(sources.centers - sources.centers[best], axis=-1) / baseline
        score = score * (1 - np.exp(-0.5 * (gap / APART) ** 2))
        score[best] = 0
    return tuple(chosen)


def parallax(center: Float64, others: Float64, points: Float64) -> Float64:
    """(S, N) degrees between the rays from ``center`` and from each of ``others`` to the points."""
    one = points - center
    two = points[None] - others[:, None]
    cosine = np.einsum("nj,snj->sn", one, two)
    cosine /= np.linalg.norm(one, axis=-1) * np.linalg.norm(two, axis=-1) + 1e-300
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def _frustum_points(camera: Cameras, depths: DepthRange) -> Float64:
    """(N, 3) world points over the camera's frustum, between the quartiles of its depths."""
    xy = pixel_grid(camera, SAMPLES_ACROSS)
    low, high = depths.lower, depths.upper
    inverse = np.linspace(1 / low, 1 / high, SAMPLE_DEPTHS)
    rays = np.concatenate([xy, np.ones_like(xy[:, :1])], axis=1) @ np.linalg.inv(camera.K[0]).T
    local = (rays[None] / inverse[:, None, None]).reshape(-1, 3)
    pose = camera.world_from_cam[0]
    return local @ pose[:3, :3].T + pose[:3, 3]


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Planes parallel to the reference's image, evenly spaced in inverse depth."""

    inverse_depths: torch.Tensor  # (D,) float32, ascending, 1 / scene units
    step: float  # their spacing


def plane_hypotheses(
    reference: Cameras, sources: Cameras, depths: DepthRange, *, planes: int | None
) -> Hypotheses:
    """As many planes as the baseline resolves on this level, or ``planes``.

    That is one per pixel of disparity in the source that moves most, between 8 and 256.
    """
    low, high = 1 / depths.far, 1 / depths.near
    if planes is None:
        rate = disparity_rate(reference, sources, depths.near, far=depths.far)
        planes = int(np.clip(np.ceil(rate.max() * (high - low)) + 1, FEWEST, MOST))
    inverse = np.linspace(low, high, planes, dtype=np.float32)
    return Hypotheses(torch.from_numpy(inverse), (high - low) / (planes - 1))


def best_plane(volume: torch.Tensor, hypotheses: Hypotheses) -> tuple[torch.Tensor, torch.Tensor]:
    """The cheapest plane of each pixel by costs (H, W, D), refined between planes by a parabola.

    (H, W) inverse depth, and (H, W) which plane was cheapest.
    """
    count = volume.shape[-1]
    index = volume.argmin(dim=-1)
    inner = index.clamp(1, count - 2)
    left, middle, right = (
        volume.gather(-1, (inner + shift)[..., None])[..., 0] for shift in (-1, 0, 1)
    )
    shift = parabola(left, middle, right)
    shift = torch.where(index == inner, shift, torch.zeros_like(shift))
    first = float(hypotheses.inverse_depths[0])
    return first + (index + shift) * hypotheses.step, index


def parabola(left: torch.Tensor, middle: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Where the parabola through costs at -1, 0 and 1 is lowest, within half a step; 0 if flat."""
    bend = left + right - 2 * middle
    lowest = (middle <= left) & (middle <= right) & (bend > 1e-6)
    shift = (left - right) / (2 * bend.clamp(min=1e-6))
    return torch.where(lowest, shift.clamp(-0.5, 0.5), torch.zeros_like(shift))
