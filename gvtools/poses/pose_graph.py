"""The poses on which all measured pairs of views agree best: Open3D's pose graph."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.poses.motions import turn_of

Float64 = NDArray[np.float64]

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


def connected(count: int, pairs: Sequence[Pair]) -> list[list[int]]:
    """Parts of the views that pairs connect, the largest first, each in order."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rows = [pair.source for pair in pairs]
    columns = [pair.target for pair in pairs]
    links = coo_matrix((np.ones(len(pairs)), (rows, columns)), shape=(count, count))
    number, label = connected_components(links, directed=False)
    parts = [np.nonzero(label == part)[0].tolist() for part in range(number)]
    return sorted(parts, key=lambda part: (-len(part), part[0]))


def first_poses(views: Sequence[int], pairs: Sequence[Pair]) -> dict[int, Float64]:
    """``world_from_cam`` of connected views along as few pairs as possible from the first one.

    Pairs of neighbours in time come before loops.
    """
    near: dict[int, list[tuple[int, Float64]]] = {}
    for pair in pairs:
        # world_from_source = world_from_target @ target_from_source
        near.setdefault(pair.target, []).append((pair.source, pair.target_from_source))
        near.setdefault(pair.source, []).append(
            (pair.target, invert_rigid(pair.target_from_source))
        )
    poses = {views[0]: np.eye(4)}
    waiting = deque([views[0]])
    while waiting:
        at = waiting.popleft()
        for other, step in near.get(at, ()):
            if other not in poses:
                poses[other] = poses[at] @ step
                waiting.append(other)
    return poses


def optimised(start: dict[int, Float64], pairs: Sequence[Pair]) -> dict[int, Float64]:
    """``world_from_cam`` by view that agree with all pairs best; the first view stays in place."""
    import open3d as o3d

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


def residual(pair: Pair, poses: dict[int, Float64]) -> tuple[float, float]:
    """By how much poses in metres depart from a measured pair: millimetres and degrees."""
    predicted = invert_rigid(poses[pair.target]) @ poses[pair.source]
    off = invert_rigid(pair.target_from_source) @ predicted
    return float(np.linalg.norm(off[:3, 3]) * 1e3), float(np.degrees(turn_of(off)))
