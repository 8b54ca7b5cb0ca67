"""Which views a reference view is compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.depth.stereo.depth_range import DepthRange, baselines, seen_points
from gvtools.depth.stereo.warps import pixel_grid
from gvtools.scenes.scene import Scene
from gvtools.view_selection import in_view

Float64 = NDArray[np.float64]

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


def choose_sources(
    scene: Scene, name: str, candidates: tuple[str, ...], *, count: int, depths: DepthRange
) -> tuple[str, ...]:
    """Names of the best source views for a reference view, best first.

    Each candidate is rated by the points of the reference that it sees too, each weighted by its
    parallax: sparse points with their tracks when the reference has enough of them, else points
    spread over its frustum inside the depth range. Candidates close to a chosen one count less, and
    those at the reference's own place are none.

    Args:
        scene: the project.
        name: the reference view.
        candidates: views that may be looked at; the reference itself is left out.
        count: how many at most.
        depths: the reference's depth range.
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
    chosen = _spread_out(score * (baseline > 0), baseline, sources.centers, count=count)
    return tuple(others[i] for i in chosen)


def parallax(center: Float64, others: Float64, points: Float64) -> Float64:
    """(S, N) degrees between the rays from ``center`` and from each of ``others`` to the points."""
    one = points - center
    two = points[None] - others[:, None]
    cosine = np.einsum("nj,snj->sn", one, two)
    cosine /= np.linalg.norm(one, axis=-1) * np.linalg.norm(two, axis=-1) + 1e-300
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def _spread_out(score: Float64, baseline: Float64, centers: Float64, *, count: int) -> list[int]:
    """Rows of the best scores, each lowered by how near it stands to those already taken.

    A score is 0 where the baseline is.
    """
    chosen: list[int] = []
    baseline = np.where(baseline > 0, baseline, np.inf)
    while len(chosen) < count and score.max() > 0:
        best = int(np.argmax(score))
        chosen.append(best)
        gap = np.linalg.norm(centers - centers[best], axis=-1) / baseline
        score = score * (1 - np.exp(-0.5 * (gap / APART) ** 2))
        score[best] = 0
    return chosen


def _frustum_points(camera: Cameras, depths: DepthRange) -> Float64:
    """(N, 3) world points over the camera's frustum, between the quartiles of its depths."""
    xy = pixel_grid(camera, SAMPLES_ACROSS)
    low, high = depths.lower, depths.upper
    inverse = np.linspace(1 / low, 1 / high, SAMPLE_DEPTHS)
    rays = np.concatenate([xy, np.ones_like(xy[:, :1])], axis=1) @ np.linalg.inv(camera.K[0]).T
    local = (rays[None] / inverse[:, None, None]).reshape(-1, 3)
    pose = camera.world_from_cam[0]
    return local @ pose[:3, :3].T + pose[:3, 3]
