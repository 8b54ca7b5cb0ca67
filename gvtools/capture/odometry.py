"""Relative poses of pairs of frames of an RGB-D recording.

A pair is registered by Open3D's hybrid odometry (colour and depth), then refined by point-to-plane
odometry (depth alone) if the depth map constrains all six degrees of freedom. Depth cameras do not
take colour and depth at quite the same time, which hybrid odometry turns into pose errors
(7-Scenes' kitchen, 40 frames in a row: 7.5 mm with hybrid odometry alone, 2.7 mm with both; every
tenth frame: 38 mm and 26 mm). A flat wall leaves point-to-plane odometry free to slide; there the
result of hybrid odometry stays.

Open3D's tensor odometry sums in the order of its threads: results differ in the fifth digit
between runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.capture.rgbd_frames import RgbdFrames, SmallFrame

if TYPE_CHECKING:
    from gvtools.capture.rgbd_frames import Features

Float64 = NDArray[np.float64]

# Iterations at a quarter, half and the full size.
ITERATIONS = (10, 5, 3)
# Points farther apart than this are not taken for corresponding ones [m].
APART = 0.07
# Points within this distance count for a pair's information matrix in the pose graph [m].
WEIGHED = 0.03
# Greater depths than FARTHEST are not used, nor greater ones than NEAR in frames with at least
# NEAR_SHARE of their depth below it [m]: a depth camera's error grows with the square of the
# distance (every tenth frame of 7-Scenes' kitchen: position errors of 26 mm, 37 mm without).
NEAR, NEAR_SHARE, FARTHEST = 2.5, 0.5, 5.0
# A pair is kept if at least LEAST_OVERLAP of a frame's pixels fall on depth of the other frame, and
# of these at least LEAST_AGREEMENT agree with it and at most MOST_IN_FRONT lie in front of it.
LEAST_OVERLAP, LEAST_AGREEMENT, MOST_IN_FRONT = 0.25, 0.7, 0.15
# Depths agree within this [m], or this share of the depth if that is more.
AGREE = 0.02
# Overlap and agreement are measured on every STEP-th pixel and row.
STEP = 4
# Depth constrains all six degrees of freedom if the smallest eigenvalue of point-to-plane alignment
# is at least this share of the largest: rooms have 0.08 to 0.2 (Redwood, 7-Scenes), a noisy wall
# 7e-5.
LEAST_CONSTRAINT = 1e-2
# That is computed from depth averaged over blocks of this side [px]: the normals of single pixels
# are so noisy that every degree of freedom would seem constrained.
BLOCK = 8
# Where point-to-plane odometry moves a pose by more than this [m, degrees], it has slid away.
MOST_SHIFT, MOST_TURN = 0.3, 15.0
# PnP with RANSAC: Lowe's ratio of matches, least number of inliers, their reprojection error [px].
RATIO, LEAST_INLIERS, INLIER_PX = 0.8, 15, 3.0


@dataclass(frozen=True, eq=False)
class Pair:
    """A measured relative pose.

    Attributes:
        source: number of a frame.
        target: number of another frame.
        target_from_source: (4, 4) rigid, metres.
        information: (6, 6) information matrix of Open3D's pose graph.
        overlap: share of the source's pixels with depth that fall on depth of the target.
        agreement: share of these that agree in depth.
        apart: median absolute difference of these depths, metres.
    """

    source: int
    target: int
    target_from_source: Float64
    information: Float64
    overlap: float
    agreement: float
    apart: float

    @property
    def good(self) -> bool:
        """Whether the frames overlap and agree enough for the pose to be right."""
        return self.overlap >= LEAST_OVERLAP and self.agreement >= LEAST_AGREEMENT


def compare(frames: RgbdFrames, source: int, target: int, *, start: Float64) -> Pair | None:
    """The relative pose of two frames; None if they do not agree.

    Args:
        frames: of the recording.
        source: number of a frame.
        target: number of another frame.
        start: (4, 4) initial ``target_from_source``, metres.
    """
    import open3d as o3d

    first, second = frames[source], frames[target]
    method = o3d.t.pipelines.odometry.Method
    reach = _reach(first.depth)
    pose = _odometry(first, second, frames.K, start=start, method=method.Hybrid, reach=reach)
    if pose is None:
        return None
    if _constrains_pose(first.depth, frames.K):
        refined = _odometry(
            first, second, frames.K, start=pose, method=method.PointToPlane, reach=reach
        )
        if refined is not None and within(refined @ invert_rigid(pose), MOST_SHIFT, MOST_TURN):
            # Keep the pose with the smaller median difference of depths.
            by = [_compared(first.depth, second.depth, frames.K, pose=at) for at in (refined, pose)]
            if by[0][2] <= by[1][2]:
                pose = refined
    overlap, agreement, apart, in_front = _compared(first.depth, second.depth, frames.K, pose=pose)
    if in_front > MOST_IN_FRONT:
        return None
    pair = Pair(
        source,
        target,
        pose,
        _information(first, second, frames.K, pose=pose),
        overlap,
        agreement,
        apart,
    )
    return pair if pair.good else None


def _odometry(
    first: SmallFrame,
    second: SmallFrame,
    K: Float64,
    *,
    start: Float64,
    method: Any,
    reach: float,
) -> Float64 | None:
    """(4, 4) ``second_from_first``, metres; None if odometry fails."""
    import open3d as o3d

    odometry = o3d.t.pipelines.odometry
    try:
        result = odometry.rgbd_odometry_multi_scale(
            first.image, second.image, o3d.core.Tensor(K), o3d.core.Tensor(start),
            depth_scale=1.0, depth_max=reach,
            criteria_list=[odometry.OdometryConvergenceCriteria(n) for n in ITERATIONS],
            method=method, params=odometry.OdometryLossParams(APART, 0.05, 0.1),
        )  # fmt: skip
    except RuntimeError:
        # No overlap, or a singular system: the geometry does not determine the pose.
        return None
    pose = result.transformation.numpy()
    return pose if np.isfinite(pose).all() and result.fitness > 0 else None


def _reach(depth: NDArray[np.float32]) -> float:
    """The greatest depth of a frame that is used, metres: NEAR or FARTHEST."""
    known = depth[(depth > 0) & (depth < FARTHEST)]
    return NEAR if (known < NEAR).sum() >= NEAR_SHARE * max(1, known.size) else FARTHEST


def _information(first: SmallFrame, second: SmallFrame, K: Float64, *, pose: Float64) -> Float64:
    import open3d as o3d

    odometry = o3d.t.pipelines.odometry
    return odometry.compute_odometry_information_matrix(
        first.image.depth, second.image.depth, o3d.core.Tensor(K), o3d.core.Tensor(pose),
        WEIGHED, 1.0, FARTHEST,
    ).numpy()  # fmt: skip


def _points(depth: NDArray[np.float32], K: Float64) -> Float64:
    """(h, w, 3) points of every STEP-th pixel in the camera's frame; NaN where there is none."""
    z = depth[::STEP, ::STEP].astype(np.float64)
    z[(z <= 0) | (z > FARTHEST)] = np.nan
    line, column = np.mgrid[: z.shape[0], : z.shape[1]] * STEP
    return np.stack([(column - K[0, 2]) / K[0, 0] * z, (line - K[1, 2]) / K[1, 1] * z, z], axis=-1)


def _block_points(depth: NDArray[np.float32], K: Float64) -> Float64:
    """(h, w, 3) points of blocks of BLOCK x BLOCK pixels; NaN where most pixels have no depth."""
    height, width = (length // BLOCK for length in depth.shape)
    blocks = depth[: height * BLOCK, : width * BLOCK].astype(np.float64)
    blocks = blocks.reshape(height, BLOCK, width, BLOCK)
    known = (blocks > 0) & (blocks < FARTHEST)
    count = known.sum(axis=(1, 3))
    z = np.full(count.shape, np.nan)
    np.divide(np.where(known, blocks, 0).sum(axis=(1, 3)), count, out=z, where=count > BLOCK**2 / 2)
    line, column = np.mgrid[:height, :width] * BLOCK + (BLOCK - 1) / 2
    return np.stack([(column - K[0, 2]) / K[0, 0] * z, (line - K[1, 2]) / K[1, 1] * z, z], axis=-1)


def within(pose: Float64, shift: float, turn: float) -> bool:
    """Whether a pose moves by at most ``shift`` (its unit) and turns by ``turn`` (degrees)."""
    cosine = np.clip((np.trace(pose[:3, :3]) - 1) / 2, -1, 1)
    return bool(np.linalg.norm(pose[:3, 3]) <= shift and np.degrees(np.arccos(cosine)) <= turn)


def _constrains_pose(depth: NDArray[np.float32], K: Float64) -> bool:
    """Whether point-to-plane alignment of a depth map determines all six degrees of freedom."""
    points = _block_points(depth, K)
    normals = np.cross(points[:-1, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, :-1])
    length = np.linalg.norm(normals, axis=-1)
    # Leave out normals across depth edges: their cross products are far longer than a surface's.
    usable = np.isfinite(length) & (length > 0)
    if usable.sum() < 50:
        return False
    usable &= length < 10 * np.median(length[usable])
    n = normals[usable] / length[usable, None]
    p = points[:-1, :-1][usable]
    p = (p - p.mean(axis=0)) / max(float(p.std()), 1e-9)
    rows = np.concatenate([np.cross(p, n), n], axis=1)
    weights = np.linalg.eigvalsh(rows.T @ rows)
    return bool(weights[0] >= LEAST_CONSTRAINT * weights[-1])


def _compared(
    first: NDArray[np.float32], second: NDArray[np.float32], K: Float64, *, pose: Float64
) -> tuple[float, float, float, float]:
    """Overlap, agreement and median difference, see ``Pair``, and the share in front of ``second``.

    Args:
        first: (h, w) depth, metres.
        second: (h, w) depth, metres.
        K: (3, 3) of both.
        pose: (4, 4) second_from_first, metres.
    """
    points = _points(first, K).reshape(-1, 3)
    points = points[np.isfinite(points[:, 2])]
    moved = points @ pose[:3, :3].T + pose[:3, 3]
    moved = moved[moved[:, 2] > 0.01]
    column = np.rint(K[0, 0] * moved[:, 0] / moved[:, 2] + K[0, 2]).astype(int)
    line = np.rint(K[1, 1] * moved[:, 1] / moved[:, 2] + K[1, 2]).astype(int)
    height, width = second.shape
    inside = (column >= 0) & (column < width) & (line >= 0) & (line < height)
    seen = second[line[inside], column[inside]]
    z = moved[inside, 2][seen > 0]
    seen = seen[seen > 0]
    if len(z) < 30:
        return 0.0, 0.0, np.inf, 1.0
    apart = np.abs(seen - z)
    agreement = float((apart < np.maximum(AGREE, AGREE * seen)).mean())
    in_front = float((z < seen - 3 * np.maximum(AGREE, AGREE * seen)).mean())
    return len(z) / len(points), agreement, float(np.median(apart)), in_front


def start_from_features(source: Features, target: Features, K: Float64) -> Float64 | None:
    """An initial ``target_from_source`` by SIFT matches and perspective-n-point with RANSAC.

    Args:
        source: features with 3D points.
        target: features with pixels.
        K: (3, 3) of the target's pixels.

    Returns:
        (4, 4) rigid, metres; None where too few matches agree.
    """
    import cv2

    known = np.nonzero(np.isfinite(source.points[:, 2]))[0]
    if min(len(known), len(target.pixels)) < LEAST_INLIERS:
        return None
    rows = _matches(source.descriptors[known], target.descriptors)
    if len(rows) < LEAST_INLIERS:
        return None
    cv2.setRNGSeed(1)
    try:
        found, turn, shift, inliers = cv2.solvePnPRansac(
            source.points[known[rows[:, 0]]], target.pixels[rows[:, 1]].astype(np.float64), K,
            None, iterationsCount=500, reprojectionError=INLIER_PX, flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
    except cv2.error:
        # Degenerate points, such as many in one place.
        return None
    if not found or inliers is None or len(inliers) < LEAST_INLIERS:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose


def _matches(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.int64]:
    """(M, 2) rows of mutually nearest descriptors that pass Lowe's ratio test."""
    products = first @ second.T
    best = products.argmax(axis=1)
    rows = np.arange(len(first))
    top = products[rows, best]
    mutual = products.argmax(axis=0)[best] == rows
    products[rows, best] = -1
    # Of unit vectors, |a - b|^2 = 2 - 2 a.b
    clear = (1 - top) < RATIO**2 * (1 - products.max(axis=1))
    return np.stack([rows, best], axis=1)[mutual & clear]


def chained(pairs: Iterable[Float64]) -> Float64:
    """The product of relative poses, the first one applied first."""
    pose = np.eye(4)
    for step in pairs:
        pose = step @ pose
    return pose
