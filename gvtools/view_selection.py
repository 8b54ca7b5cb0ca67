"""Selection of views: the nearest to some cameras, those that see the same, a few of many.

Needs numpy alone. Rows of ``Cameras`` come back, the best first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64

Item = TypeVar("Item")

# Views that tell enough of many, such as the typical depth of a project.
FEW = 8
# Pixels of a target that stand for all of it.
SAMPLES = 300
# Radians between two rays to a point at which what one shows counts 37 % for the other.
PARALLAX = 0.5
# A view whose own depth is nearer than a point's by more than this share does not see the point.
SAME_DEPTH = 0.1


def evenly_spread(items: Sequence[Item], count: int = FEW) -> Sequence[Item]:
    """At most ``count`` of the items, from the first on at equal steps."""
    return items[:: -(-len(items) // count)] if items else items


def nearest_views(
    cameras: Cameras, targets: Cameras, count: int, *, unit: float | None = None
) -> list[int]:
    """The cameras that stand and look most like the targets, the very best first.

    The first is the best for all targets together; each of the others is the one that most improves
    on the targets served worst. A right angle between viewing directions weighs as much as a
    distance of ``unit``.

    Args:
        targets: at least one camera.
        unit: distance, scene units; None takes the extent of all camera centres.
    """
    centers, target_centers = cameras.centers, targets.centers
    everything = np.concatenate((centers, target_centers))
    # Centres that differ by their rounding alone are one place.
    least = 1e-9 * max(float(np.abs(everything).max()), 1e-12)
    if unit is None:
        unit = max(float(np.linalg.norm(np.ptp(everything, axis=0))), least)
    distance = np.linalg.norm(centers[:, None] - target_centers[None], axis=-1) / unit
    forward, target_forward = cameras.world_from_cam[:, :3, 2], targets.world_from_cam[:, :3, 2]
    cost = distance + 1 - np.clip(forward @ target_forward.T, -1, 1)
    chosen = [int(cost.mean(1).argmin())] if count > 0 else []
    while len(chosen) < min(count, len(cameras)):
        served = cost[chosen].min(0)
        gain = np.maximum(served[None] - cost, 0).sum(1)
        gain[chosen] = -1
        best = int(gain.argmax())
        if gain[best] <= 0:
            order = np.argsort(cost.min(1), kind="stable").tolist()
            best = next(row for row in order if row not in chosen)
        chosen.append(best)
    return chosen


def covisible_views(
    cameras: Cameras,
    targets: Cameras,
    target_depth: NDArray[np.float32],
    *,
    count: int,
    depths: Sequence[NDArray[np.float32] | None],
) -> list[int]:
    """The cameras that together see most of what the targets show, the very best first.

    A point counts by the best of the chosen cameras alone: as far as that looks at it along the
    same ray and no closer surface of its own depth stands before it. So a second view of the same
    part gains little. Cameras that add nothing follow in the order of ``nearest_views``.

    Args:
        target_depth: (T, H, W) z-depth, scene units; 0 and what is not finite do not count.
        depths: for each camera its own z-depth (H, W), scene units, 0 = none; None without any.
    """
    points, directions = _surface_samples(targets, target_depth)
    seen = _visibility(cameras, points, directions, depths=depths)
    best = np.zeros(seen.shape[1])
    chosen: list[int] = []
    while len(chosen) < min(count, len(cameras)):
        gain = np.maximum(seen - best, 0).sum(1)
        gain[chosen] = 0
        row = int(gain.argmax())
        if gain[row] <= 0:
            break
        chosen.append(row)
        best = np.maximum(best, seen[row])
    others = [row for row in range(len(cameras)) if row not in chosen]
    if not others or len(chosen) >= count:
        return chosen
    more = nearest_views(cameras[others], targets, count - len(chosen))
    return chosen + [others[row] for row in more]


def in_view(cameras: Cameras, points: Float64) -> NDArray[np.bool_]:
    """(V, N) whether each point (N, 3), world frame, projects into each camera's picture."""
    xy, z = cameras.project(points)
    return _in_picture(cameras, xy, z)


def _in_picture(cameras: Cameras, xy: Float64, z: Float64) -> NDArray[np.bool_]:
    size = np.stack([cameras.width, cameras.height], axis=-1)[:, None]
    with np.errstate(invalid="ignore"):
        return (z > 0) & (xy > 0).all(-1) & (xy < size).all(-1)


def _surface_samples(targets: Cameras, depth: NDArray[np.float32]) -> tuple[Float64, Float64]:
    """World points (N, 3) on the targets' surfaces, and the unit rays (N, 3) to them."""
    points, directions = [], []
    for row in range(len(targets)):
        rows, columns = np.nonzero((depth[row] > 0) & np.isfinite(depth[row]))
        some = slice(None, None, max(1, len(rows) // SAMPLES))
        rows, columns = rows[some], columns[some]
        ray = targets.rays(row)[rows, columns] @ targets.world_from_cam[row, :3, :3].T
        points.append(targets.centers[row] + ray * depth[row, rows, columns, None])
        directions.append(ray / np.linalg.norm(ray, axis=-1, keepdims=True))
    return np.concatenate(points), np.concatenate(directions)


def _visibility(
    cameras: Cameras,
    points: Float64,
    directions: Float64,
    *,
    depths: Sequence[NDArray[np.float32] | None],
) -> Float64:
    """(V, N) in [0, 1]: how well each camera shows the points as seen along the directions."""
    xy, z = cameras.project(points)
    inside = _in_picture(cameras, xy, z)
    ray = points - cameras.centers[:, None]
    ray /= np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    angle = np.arccos(np.clip((ray * directions).sum(-1), -1, 1))
    out: Float64 = np.where(inside, np.exp(-angle / PARALLAX), 0.0)
    for row, depth in enumerate(depths):
        if depth is not None:
            mine = inside[row]
            column, line = xy[row, mine].astype(np.int64).T
            surface = depth[line, column]
            out[row, mine] *= ~((surface > 0) & (surface < z[row, mine] * (1 - SAME_DEPTH)))
    return out
