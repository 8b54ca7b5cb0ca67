"""Which photographs a pass looks at: those that see what its targets show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64
from gvtools.completers.base import ContextView

# Pixels of a target that stand for all of it.
SAMPLES = 300
# Radians between two rays to a point at which what one shows counts 37 % for the other.
PARALLAX = 0.5
# A photograph's depth within this share of a point's sees the point.
SAME_DEPTH = 0.1


def covisible_views(
    context: Sequence[ContextView], targets: Cameras, depth: NDArray[np.float32], count: int
) -> list[ContextView]:
    """The context views that together see most of what the targets show, the best one first.

    A point counts by the best of the chosen views alone: as far as that looks at it along the same
    ray and no closer surface of its own depth stands before it. So a second view of the same part
    gains little. Views that add nothing follow by how they stand, see ``nearest_views``.

    Args:
        context: to choose from.
        targets: V cameras of one picture size.
        depth: (V, H, W) z-depth, scene units, filled where that is possible; 0 and what is not
            finite count not.
        count: how many to choose.
    """
    if len(context) <= 1:
        return list(context)
    points, directions = _samples(targets, depth)
    visibility = np.stack([_visibility(view, points, directions) for view in context])
    best = np.zeros(visibility.shape[1])
    chosen: list[int] = []
    while len(chosen) < min(count, len(context)):
        gain = np.maximum(visibility - best, 0).sum(1)
        gain[chosen] = 0
        first = int(gain.argmax())
        if gain[first] <= 0:
            break
        chosen.append(first)
        best = np.maximum(best, visibility[first])
    rest = [view for index, view in enumerate(context) if index not in chosen]
    more = nearest_views(rest, targets, count - len(chosen)) if len(chosen) < count else []
    return [context[index] for index in chosen] + more


def _samples(targets: Cameras, depth: NDArray[np.float32]) -> tuple[Float64, Float64]:
    """World points (N, 3) on the targets' surfaces, and unit rays (N, 3) that they are seen by."""
    points, directions = [], []
    for row in range(len(targets)):
        rows, columns = np.nonzero((depth[row] > 0) & np.isfinite(depth[row]))
        some = slice(None, None, max(1, len(rows) // SAMPLES))
        rows, columns = rows[some], columns[some]
        ray = targets.rays(row)[rows, columns] @ targets.world_from_cam[row, :3, :3].T
        points.append(targets.centers[row] + ray * depth[row, rows, columns, None])
        directions.append(ray / np.linalg.norm(ray, axis=-1, keepdims=True))
    return np.concatenate(points), np.concatenate(directions)


def _visibility(view: ContextView, points: Float64, directions: Float64) -> Float64:
    """(N,) in [0, 1]: how well the view shows the points as they are seen along directions."""
    (xy,), (z,) = view.camera.project(points)
    width, height = int(view.camera.width[0]), int(view.camera.height[0])
    inside = (z > 0) & (xy > 0).all(-1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    away = points - view.camera.centers[0]
    away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    angle = np.arccos(np.clip((away * directions).sum(-1), -1, 1))
    out = np.where(inside, np.exp(-angle / PARALLAX), 0.0)
    if view.depth is not None:
        column, row = xy[inside].astype(np.int64).T
        stands = view.depth[row, column]
        out[inside] *= ~((stands > 0) & (stands < z[inside] * (1 - SAME_DEPTH)))
    return out


def nearest_views(
    context: Sequence[ContextView], targets: Cameras, count: int
) -> list[ContextView]:
    """The context views that stand and look most like the targets, the best one first.

    Distances are in units of the scene's extent between cameras; a right angle between viewing
    directions weighs as much as that extent.
    """
    if len(context) <= 1:
        return list(context)
    centres = np.concatenate([view.camera.centers for view in context])
    forward = np.concatenate([view.camera.world_from_cam[:, :3, 2] for view in context])
    target_centres, target_forward = targets.centers, targets.world_from_cam[:, :3, 2]
    everything = np.concatenate((centres, target_centres))
    # Centres that differ by their rounding alone are one place.
    least = 1e-9 * max(float(np.abs(everything).max()), 1e-12)
    extent = max(float(np.linalg.norm(np.ptp(everything, axis=0))), least)
    apart = np.linalg.norm(centres[:, None] - target_centres[None], axis=-1) / extent
    turned = 1 - np.clip(forward @ target_forward.T, -1, 1)
    cost = apart + turned
    # The best for any target first, then those that are best for the targets served worst.
    chosen: list[int] = [int(cost.mean(1).argmin())]
    while len(chosen) < min(count, len(context)):
        served = cost[chosen].min(0)
        gain = np.maximum(served[None] - cost, 0).sum(1)
        gain[chosen] = -1
        best = int(gain.argmax())
        if gain[best] <= 0:
            rest = [index for index in np.argsort(cost.min(1), kind="stable")]
            best = next(int(index) for index in rest if int(index) not in chosen)
        chosen.append(best)
    return [context[index] for index in chosen]
