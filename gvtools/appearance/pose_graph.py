"""Poses of RGB-D views from the views themselves: Open3D's odometry in a pose graph.

Poses that come from a tracker err by centimetres and tenths of degrees. Pairs of views that overlap
tell their relative pose far better, by colour and depth together. A pose graph finds the poses that
agree with all pairs best; as a whole they are put where the given ones are.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from gvtools.appearance.fit_views import FitView
from gvtools.similarity import align_poses

# Pictures are compared at this length of the longer side [px], each with so many neighbours.
SIDE, NEIGHBORS = 320, 3
# Open3D's limits are metres for rooms; depth is scaled so that its median becomes this.
TYPICAL_DEPTH = 2.0
# Points that are farther apart than this do not belong together [scaled depth].
APART = 0.03
# More than any scaled depth.
FARTHEST = 1e3
# A pair counts when this share of a picture overlaps, and moves by less than this [scaled depth,
# rad] from the given poses: more is not a tracker's error but a comparison that went wrong.
OVERLAP, MOST_SHIFT, MOST_TURN = 0.1, 0.12, 0.07
# Steps of the comparison at half and all of the size.
ITERATIONS = (10, 5)
# Relative poses are rounded to so many digits, so that they are, but for a rare case, the same
# every time: threads add in any order. Open3D's tensor odometry is twice as fast, but differs from
# time to time in the fifth digit.
DIGITS = 9
# Neighbours along the path keep their given relative pose by this share of a pair's weight, so that
# views that overlap with none stay where they were.
GIVEN_WEIGHT = 0.01


class _Camera(NamedTuple):
    """One camera for all views: intrinsics (3, 3) at the reduced size, width and height."""

    K: NDArray[np.float64]
    size: tuple[int, int]

    @property
    def intrinsics(self) -> o3d.camera.PinholeCameraIntrinsic:
        """As Open3D wants them, which counts pixels from the first one's centre."""
        K = self.K
        return o3d.camera.PinholeCameraIntrinsic(
            *self.size, K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5
        )


def agreeing_poses(views: Iterable[FitView]) -> NDArray[np.float64]:
    """Poses on which neighbouring views agree.

    Args:
        views: all with depth, neighbours along the path beside each other.

    Returns:
        (V, 4, 4) refined ``cam_from_local``; all are moved together so that they are, on average,
        where they were given.
    """
    views = list(views)
    height, width = views[0].rgb.shape[:2]
    scale = min(1.0, SIDE / max(height, width))
    size = (round(width * scale), round(height * scale))
    smaller = [np.diag([*(np.array(size) / view.rgb.shape[1::-1]), 1]) for view in views]
    K = np.median([a @ view.K for a, view in zip(smaller, views, strict=True)], axis=0)
    K[0, 1] = 0  # Open3D knows no skew; views that have some are warped
    camera = _Camera(K, size)
    depths = [_depth(view)[::8, ::8] for view in views]
    known = np.concatenate([depth[depth > 0] for depth in depths])
    if not len(known):
        return np.stack([view.cam_from_local for view in views])
    unit = np.diag([1.0, 1.0, 1.0, TYPICAL_DEPTH / np.median(known)])
    given = [np.linalg.inv(unit) @ view.cam_from_local @ unit for view in views]
    images = [_image(view, camera, TYPICAL_DEPTH / np.median(known)) for view in views]
    pairs = neighbors(np.stack(given))
    edges = [_edge(images, given, (i, j), camera=camera) for i, j in pairs]
    refined = _optimized(given, [edge for edge in edges if edge is not None])
    moved = refined @ align_poses(refined, np.stack(given))
    return np.asarray(unit @ moved @ np.linalg.inv(unit))


def neighbors(poses: NDArray[np.float64], *, count: int = NEIGHBORS) -> list[tuple[int, int]]:
    """Pairs of cameras that stand and look alike: each with so many others.

    Args:
        poses: (V, 4, 4) camera from world; lengths in units of about half the typical depth.
        count: how many others.
    """
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    pairs = set()
    for row in range(len(poses)):
        apart = np.linalg.norm(centers - centers[row], axis=1) / TYPICAL_DEPTH
        apart += np.arccos(np.clip(poses[:, 2, :3] @ poses[row, 2, :3], -1, 1))
        apart[row] = np.inf
        nearest = np.argsort(apart, kind="stable")[: min(count, len(poses) - 1)]
        pairs |= {(min(row, int(other)), max(row, int(other))) for other in nearest}
    return sorted(pairs)


def _depth(view: FitView) -> NDArray[np.float32]:
    assert view.depth is not None
    return view.depth if view.mask is None else view.depth * view.mask


def _image(view: FitView, camera: _Camera, scale: float) -> o3d.geometry.RGBDImage:
    """A view as the common camera sees it, with scaled depth."""
    # Pixels count from the first one's corner in ``K``, from its centre in OpenCV.
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    smaller = (np.linalg.inv(shift) @ camera.K @ np.linalg.inv(view.K) @ shift)[:2]
    blur = 0.4 / smaller[0, 0]
    rgb = cv2.GaussianBlur(view.rgb, (0, 0), blur) if blur > 0.5 else view.rgb
    rgb = cv2.warpAffine(
        rgb, smaller, camera.size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    depth = cv2.warpAffine(
        (_depth(view) * scale).astype(np.float32), smaller, camera.size, flags=cv2.INTER_NEAREST
    )
    return o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(np.ascontiguousarray(rgb)),
        o3d.geometry.Image(np.ascontiguousarray(depth)),
        depth_scale=1.0,
        depth_trunc=FARTHEST,
        convert_rgb_to_intensity=True,
    )


def _edge(
    images: list[o3d.geometry.RGBDImage],
    given: list[NDArray[np.float64]],
    pair: tuple[int, int],
    *,
    camera: _Camera,
) -> o3d.pipelines.registration.PoseGraphEdge | None:
    """The relative pose of two views, or None if they do not tell it."""
    odometry = o3d.pipelines.odometry
    begin = given[pair[1]] @ np.linalg.inv(given[pair[0]])
    found, motion, weight = odometry.compute_rgbd_odometry(
        images[pair[0]],
        images[pair[1]],
        camera.intrinsics,
        begin,
        odometry.RGBDOdometryJacobianFromHybridTerm(),
        odometry.OdometryOption(
            iteration_number_per_pyramid_level=o3d.utility.IntVector(ITERATIONS),
            depth_diff_max=APART,
            depth_min=0.0,
            depth_max=FARTHEST,
        ),
    )
    change = motion @ np.linalg.inv(begin)
    turn = np.arccos(np.clip((np.trace(change[:3, :3]) - 1) / 2, -1, 1))
    right = np.linalg.norm(change[:3, 3]) < MOST_SHIFT and turn < MOST_TURN
    # The last number of the weight counts the pixels that correspond.
    if not (found and right and weight[5, 5] > OVERLAP * camera.size[0] * camera.size[1]):
        return None
    edge = o3d.pipelines.registration.PoseGraphEdge
    return edge(*pair, motion.round(DIGITS), weight.round(), uncertain=True)


def _optimized(
    given: list[NDArray[np.float64]], edges: list[o3d.pipelines.registration.PoseGraphEdge]
) -> NDArray[np.float64]:
    """(V, 4, 4) poses that agree with the edges; edges that contradict the others are left out."""
    registration = o3d.pipelines.registration
    if not edges:
        return np.stack(given)
    weight = GIVEN_WEIGHT * float(np.median([edge.information[5, 5] for edge in edges]))
    graph = registration.PoseGraph()
    for pose in given:
        graph.nodes.append(registration.PoseGraphNode(np.linalg.inv(pose)))
    for edge in edges:
        graph.edges.append(edge)
    for row in range(len(given) - 1):
        motion = given[row + 1] @ np.linalg.inv(given[row])
        graph.edges.append(
            registration.PoseGraphEdge(row, row + 1, motion, weight * np.eye(6), uncertain=False)
        )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            registration.GlobalOptimizationOption(reference_node=0),
        )
    return np.stack([np.linalg.inv(node.pose) for node in graph.nodes])
