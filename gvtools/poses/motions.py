"""Rigid motions between poses, cameras that stand and look alike, and the pose graph of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Float64

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
    """(C,) mean of the ``values`` (V, C) of the cameras that stand and look most like a pose.

    ``depth`` is typical, scene units; ``reach``: how fast weights fall with distance (in shares of
    the depth) and angle [rad], see ``NEAR_SHIFT``.
    """
    center = -pose[:3, :3].T @ pose[:3, 3]
    angle = np.arccos(np.clip(poses[:, 2, :3] @ pose[2, :3], -1, 1))
    shift, turn = reach
    apart = np.linalg.norm(centers_of(poses) - center, axis=1) / (shift * depth) + angle / turn
    apart[list(but)] = np.inf
    near = np.argsort(apart, kind="stable")[:count]
    weight = np.exp(apart[near].min() - apart[near])
    return np.asarray(weight @ values[near] / weight.sum())


def move_pose(pose: Float64, motion: Float64) -> Float64:
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


# An uncertain pair whose weight in the optimisation falls below this is wrong, and taken out.
PRUNED = 0.25


@dataclass(frozen=True, eq=False)
class Pair:
    """A measured relative pose of two views, by their numbers."""

    source: int
    target: int
    target_from_source: Float64  # (4, 4) rigid
    information: Float64  # (6, 6) of Open3D's pose graph
    # May be wrong, and then loses its weight.
    uncertain: bool
    # Share of the source's pixels with depth that fall on depth of the target, and of these the
    # share that agrees in depth.
    overlap: float = 1.0
    agreement: float = 1.0


def optimise(start: dict[int, Float64], pairs: Sequence[Pair]) -> dict[int, Float64]:
    """``world_from_cam`` by view that agree with all pairs best; the first view stays in place."""
    from gvtools.o3d import o3d

    registration = o3d.pipelines.registration
    graph = registration.PoseGraph()
    node = {view: number for number, view in enumerate(start)}
    for pose in start.values():
        graph.nodes.append(registration.PoseGraphNode(pose))
    for pair in pairs:
        graph.edges.append(
            registration.PoseGraphEdge(
                node[pair.source], node[pair.target], pair.target_from_source, pair.information,
                pair.uncertain,
            )
        )  # fmt: skip
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            registration.GlobalOptimizationOption(
                max_correspondence_distance=0.03, edge_prune_threshold=PRUNED, reference_node=0
            ),
        )
    return {view: np.array(graph.nodes[node[view]].pose) for view in start}
