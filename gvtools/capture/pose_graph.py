"""The poses on which all measured pairs of frames agree best: Open3D's pose graph."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.capture.odometry import Pair

Float64 = NDArray[np.float64]

# A loop whose weight in the optimisation falls below this is a wrong one, and taken out.
PRUNED = 0.25


def connected(count: int, pairs: Sequence[Pair]) -> list[list[int]]:
    """Parts of frames that pairs connect, the largest first, each in order."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rows = [pair.source for pair in pairs]
    columns = [pair.target for pair in pairs]
    links = coo_matrix((np.ones(len(pairs)), (rows, columns)), shape=(count, count))
    number, label = connected_components(links, directed=False)
    parts = [np.nonzero(label == part)[0].tolist() for part in range(number)]
    return sorted(parts, key=lambda part: (-len(part), part[0]))


def first_poses(frames: Sequence[int], pairs: Sequence[Pair]) -> dict[int, Float64]:
    """``world_from_cam`` of connected frames along as few pairs as possible from the first one.

    Args:
        frames: that the pairs connect.
        pairs: neighbours in time before loops.
    """
    near: dict[int, list[tuple[int, Float64]]] = {}
    for pair in pairs:
        # world_from_source = world_from_target @ target_from_source
        near.setdefault(pair.target, []).append((pair.source, pair.target_from_source))
        near.setdefault(pair.source, []).append(
            (pair.target, invert_rigid(pair.target_from_source))
        )
    poses = {frames[0]: np.eye(4)}
    waiting = deque([frames[0]])
    while waiting:
        at = waiting.popleft()
        for other, step in near.get(at, ()):
            if other not in poses:
                poses[other] = poses[at] @ step
                waiting.append(other)
    return poses


def optimised(
    frames: Sequence[int], pairs: Sequence[Pair], *, start: dict[int, Float64]
) -> dict[int, Float64]:
    """Poses that agree with all pairs best; wrong loops lose their weight.

    Args:
        frames: that the pairs connect, in order; the first one stays where it is.
        pairs: of these frames.
        start: ``world_from_cam`` of each.

    Returns:
        (4, 4) ``world_from_cam`` of each frame, metres.
    """
    import open3d as o3d

    registration = o3d.pipelines.registration
    graph = registration.PoseGraph()
    node = {frame: number for number, frame in enumerate(frames)}
    for frame in frames:
        graph.nodes.append(registration.PoseGraphNode(start[frame]))
    for pair in pairs:
        graph.edges.append(
            registration.PoseGraphEdge(
                node[pair.source], node[pair.target], pair.target_from_source, pair.information,
                abs(pair.source - pair.target) > 1,
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
    return {frame: np.array(graph.nodes[node[frame]].pose) for frame in frames}


def residual(pair: Pair, poses: dict[int, Float64]) -> tuple[float, float]:
    """By how much poses depart from a measured pair: millimetres and degrees."""
    predicted = invert_rigid(poses[pair.target]) @ poses[pair.source]
    off = invert_rigid(pair.target_from_source) @ predicted
    cosine = np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(off[:3, 3]) * 1e3), float(np.degrees(np.arccos(cosine)))
