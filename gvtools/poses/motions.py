"""Rigid motions between poses, and the cameras that stand and look alike."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

# Views that a camera takes its correction from, and how fast their weight falls: it is proportional
# to exp(-(distance / (NEAR_SHIFT typical depths) + angle of viewing directions [rad] / NEAR_TURN)).
NEAR_VIEWS, NEAR_SHIFT, NEAR_TURN = 2, 0.03, 0.05


def centers_of(poses: Float64) -> Float64:
    """(V, 3) where cameras stand, by poses (V, 4, 4) camera from any frame."""
    return -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])


def nearest(
    poses: Float64, row: int, *, count: int, shift: float, by_angle: bool = False
) -> NDArray[np.int64]:
    """Rows of the ``count`` poses that stand and look most like another one, the best first.

    Distances are counted in units of ``shift``; to these comes 1 - cos of the angle between viewing
    directions, or the angle [rad] if ``by_angle``.
    """
    centers = centers_of(poses)
    apart = np.linalg.norm(centers - centers[row], axis=1) / shift
    cosine = np.clip(poses[:, 2, :3] @ poses[row, 2, :3], -1, 1)
    apart += np.arccos(cosine) if by_angle else 1 - cosine
    apart[row] = np.inf
    return np.argsort(apart, kind="stable")[: min(count, len(poses) - 1)]


def nearest_pairs(
    poses: Float64, *, count: int, shift: float, by_angle: bool = False
) -> list[tuple[int, int]]:
    """Pairs of each pose with its nearest ones, see ``nearest``."""
    return sorted({
        (min(row, int(other)), max(row, int(other)))
        for row in range(len(poses))
        for other in nearest(poses, row, count=count, shift=shift, by_angle=by_angle)
    })  # fmt: skip


def mean_near(
    pose: Float64,
    poses: Float64,
    values: Float64,
    *,
    depth: float,
    but: Sequence[int] = (),
    count: int = NEAR_VIEWS,
    reach: tuple[float, float] = (NEAR_SHIFT, NEAR_TURN),
) -> Float64:
    """(C,) mean of what belongs to the cameras that stand and look most like a pose.

    Args:
        pose: (4, 4) camera from any frame.
        poses: (V, 4, 4) of the cameras, in the same frame.
        values: (V, C) what belongs to each camera.
        depth: typical depth, scene units.
        reach: how fast weights fall with distance (in shares of the depth) and angle [rad], see
            ``NEAR_SHIFT``.
    """
    center = -pose[:3, :3].T @ pose[:3, 3]
    angle = np.arccos(np.clip(poses[:, 2, :3] @ pose[2, :3], -1, 1))
    shift, turn = reach
    apart = np.linalg.norm(centers_of(poses) - center, axis=1) / (shift * depth) + angle / turn
    apart[list(but)] = np.inf
    near = np.argsort(apart, kind="stable")[:count]
    weight = np.exp(apart[near].min() - apart[near])
    return np.asarray(weight @ values[near] / weight.sum())


def moved(pose: Float64, motion: Float64) -> Float64:
    """A pose (4, 4) after a motion (6,), shift and turn, on the camera's side."""
    import torch
    from kornia.geometry.liegroup import Se3

    return Se3.exp(torch.from_numpy(motion)[None]).matrix()[0].detach().numpy() @ pose


def motions_between(given: Float64, poses: Float64) -> Float64:
    """(V, 6) shift and turn from poses (V, 4, 4) to others, on the camera's side."""
    import torch
    from kornia.geometry.liegroup import Se3

    change = torch.from_numpy(poses @ np.linalg.inv(given))
    return np.asarray(Se3.from_matrix(change).log().detach())


def turn_of(motion: Float64) -> float:
    """Angle of a rigid motion (4, 4) [rad]."""
    return float(np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1)))


def within(motion: Float64, shift: float, turn: float) -> bool:
    """Whether a motion moves by at most ``shift`` (its unit) and turns by ``turn`` (degrees)."""
    return bool(np.linalg.norm(motion[:3, 3]) <= shift and np.degrees(turn_of(motion)) <= turn)


def chained(motions: Iterable[Float64]) -> Float64:
    """The product of relative poses (4, 4), the first one applied first."""
    pose = np.eye(4)
    for step in motions:
        pose = step @ pose
    return pose
