"""Odometry of RGB-D: relative poses of two views by their colour and depth.

``compare`` takes frames of a recording, of which nothing is known. A pair is registered by Open3D's
hybrid odometry (colour and depth), then refined by point-to-plane odometry (depth alone) if the
depth map constrains all six degrees of freedom. Depth cameras do not take colour and depth at quite
the same time, which hybrid odometry turns into pose errors (7-Scenes' kitchen, 40 frames in a row:
7.5 mm with hybrid odometry alone, 2.7 mm with both; every tenth frame: 38 mm and 26 mm). A flat
wall leaves point-to-plane odometry free to slide; there the result of hybrid odometry stays.
Open3D's tensor odometry sums in the order of its threads: results differ in the fifth digit between
runs.

``register`` starts from poses that are nearly right, and gives, but for a rare case, the same every
time: Open3D's older odometry, half as fast.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid, rigid_poses
from gvtools.features import mutual_nearest, root_sift
from gvtools.poses.motions import Pair, turn_of, within
from gvtools.scenes.scene import Scene

if TYPE_CHECKING:
    from open3d.geometry import RGBDImage as LegacyImage
    from open3d.t.geometry import RGBDImage

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Frames are compared at this length of the longer side [px]: 640 takes four times as long and is
# no more exact (7-Scenes clip: errors of positions of 2.4 mm at 640, 2.2 mm at 320).
SIDE = 320
# Features are found at this length of the longer side [px].
FEATURE_SIDE, MAX_FEATURES = 640, 1500
# Side of the thumbnails by which frames are told to look alike [px].
THUMBNAIL = (32, 24)
# Frames in memory at a time, of about 0.7 MB each.
CACHED = 400
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
# ``register`` works on depth scaled to TYPICAL_DEPTH: Open3D's limits are metres for rooms. Points
# farther apart than REGISTERED_APART do not belong together [scaled depth].
TYPICAL_DEPTH, REGISTERED_APART = 2.0, 0.03
# More than any scaled depth.
BEYOND = 1e3
# A pair counts when this share of a picture overlaps, and moves by less than this [scaled depth,
# rad] from the given poses: more is not a tracker's error but a comparison that went wrong.
OVERLAP, REGISTERED_SHIFT, REGISTERED_TURN = 0.1, 0.12, 0.07
# Steps of ``register`` at half and all of the size.
REGISTERED_ITERATIONS = (10, 5)
# Its relative poses are rounded to so many digits, as threads add in any order.
DIGITS = 9


@dataclass(frozen=True, eq=False)
class SmallFrame:
    """One frame at the reduced size, depth in metres, 0 = none."""

    image: RGBDImage
    depth: Float32


@dataclass(frozen=True, eq=False)
class FrameFeatures:
    """SIFT features of a frame with their places in space, and a thumbnail."""

    # (N, 2) at FEATURE_SIDE, the first pixel's centre being (0, 0).
    pixels: Float32
    # (N, 128) RootSIFT.
    descriptors: Float32
    # (N, 3) in the camera's frame, metres; NaN where there is no depth.
    points: Float64
    # (N,) grey, of zero mean and unit length.
    thumbnail: Float64


class RgbdFrames:
    """Frames of an RGB-D scene of one camera, reduced and cached; poses are not used."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        camera = scene.views[0].camera
        self._size = _reduced_size(camera.width[0], camera.height[0], side=SIDE)
        #: (3, 3) at the reduced size, the first pixel's centre being (0, 0) as Open3D counts.
        self.K = _centre_origin(camera.resized(*self._size).K[0])
        self.feature_size = _reduced_size(camera.width[0], camera.height[0], side=FEATURE_SIDE)
        #: (3, 3) of the features' pixels.
        self.feature_K = _centre_origin(camera.resized(*self.feature_size).K[0])
        self._frames: OrderedDict[int, SmallFrame] = OrderedDict()
        self._features: dict[int, FrameFeatures] = {}

    def __len__(self) -> int:
        return len(self.scene)

    def __getitem__(self, index: int) -> SmallFrame:
        if index not in self._frames:
            self._frames[index] = self._load(index)
            if len(self._frames) > CACHED:
                self._frames.popitem(last=False)
        self._frames.move_to_end(index)
        return self._frames[index]

    def _load(self, index: int) -> SmallFrame:
        import cv2

        from gvtools.o3d import o3d

        frame = self.scene.views[index].load()
        assert frame.depth is not None
        rgb = cv2.resize(frame.rgb, self._size, interpolation=cv2.INTER_AREA)
        depth = np.asarray(
            cv2.resize(frame.depth, self._size, interpolation=cv2.INTER_NEAREST), np.float32
        )
        image = o3d.t.geometry.RGBDImage(
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(rgb))),
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth[..., None]))),
        )
        return SmallFrame(image, depth)

    def features(self, index: int) -> FrameFeatures:
        """Features of a frame; all are kept in memory, so ask for keyframes alone."""
        if index not in self._features:
            self._features[index] = self._find(index)
        return self._features[index]

    def _find(self, index: int) -> FrameFeatures:
        import cv2

        frame = self.scene.views[index].load()
        assert frame.depth is not None
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, self.feature_size, interpolation=cv2.INTER_AREA)
        depth = cv2.resize(frame.depth, self.feature_size, interpolation=cv2.INTER_NEAREST)
        keypoints, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(grey, None)
        thumbnail = _thumbnail(grey)
        if not keypoints:
            none = np.zeros((0, 128), np.float32)
            return FrameFeatures(none[:, :2], none, np.zeros((0, 3)), thumbnail)
        pixels = np.array([keypoint.pt for keypoint in keypoints], np.float32)
        column, line = np.rint(pixels).astype(int).T
        z = depth[line.clip(0, depth.shape[0] - 1), column.clip(0, depth.shape[1] - 1)]
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(self.feature_K).T
        points = rays * np.where(z > 0, z, np.nan)[:, None]
        rooted = root_sift(np.asarray(descriptors, np.float32))
        return FrameFeatures(pixels, rooted, points, thumbnail)


def compare(frames: RgbdFrames, source: int, target: int, *, start: Float64) -> Pair | None:
    """The relative pose of two frames, from an initial ``target_from_source``; None if unlike."""
    from gvtools.o3d import o3d

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
            by = [_compare(first.depth, second.depth, frames.K, pose=at) for at in (refined, pose)]
            if by[0][2] <= by[1][2]:
                pose = refined
    overlap, agreement, _, in_front = _compare(first.depth, second.depth, frames.K, pose=pose)
    if overlap < LEAST_OVERLAP or agreement < LEAST_AGREEMENT or in_front > MOST_IN_FRONT:
        return None
    information = o3d.t.pipelines.odometry.compute_odometry_information_matrix(
        first.image.depth, second.image.depth, o3d.core.Tensor(frames.K), o3d.core.Tensor(pose),
        WEIGHED, 1.0, FARTHEST,
    ).numpy()  # fmt: skip
    uncertain = abs(source - target) > 1
    return Pair(source, target, pose, information, uncertain, overlap, agreement)


def _odometry(
    first: SmallFrame, second: SmallFrame, K: Float64, *, start: Float64, method: Any, reach: float
) -> Float64 | None:
    """(4, 4) ``second_from_first``, metres; None if odometry fails."""
    from gvtools.o3d import o3d

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


def _compare(
    first: NDArray[np.float32], second: NDArray[np.float32], K: Float64, *, pose: Float64
) -> tuple[float, float, float, float]:
    """Overlap and agreement, see ``Pair``, median difference, and share in front of ``second``."""
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


def start_from_features(source: FrameFeatures, target: FrameFeatures, K: Float64) -> Float64 | None:
    """An initial ``target_from_source`` by matched SIFT and perspective-n-point with RANSAC.

    ``K`` is that of the pixels; None where too few matches agree.
    """
    import cv2

    known = np.nonzero(np.isfinite(source.points[:, 2]))[0]
    if min(len(known), len(target.pixels)) < LEAST_INLIERS:
        return None
    rows = mutual_nearest(source.descriptors[known], target.descriptors, ratio=RATIO)
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
    return rigid_poses(cv2.Rodrigues(turn)[0], shift.ravel())


def register(
    first: LegacyImage, second: LegacyImage, K: Float64, *, size: tuple[int, int], start: Float64
) -> tuple[Float64, Float64] | None:
    """``second_from_first`` (4, 4) near an initial one and its information matrix (6, 6), or None.

    Both images have this size and intrinsics (the first pixel's centre is (0.5, 0.5)), and depth
    scaled to TYPICAL_DEPTH.
    """
    from gvtools.o3d import o3d

    odometry = o3d.pipelines.odometry
    # Open3D counts pixels from the first one's centre.
    intrinsics = o3d.camera.PinholeCameraIntrinsic(
        *size, K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5
    )
    found, motion, weight = odometry.compute_rgbd_odometry(
        first, second, intrinsics, start, odometry.RGBDOdometryJacobianFromHybridTerm(),
        odometry.OdometryOption(
            iteration_number_per_pyramid_level=o3d.utility.IntVector(REGISTERED_ITERATIONS),
            depth_diff_max=REGISTERED_APART, depth_min=0.0, depth_max=BEYOND,
        ),
    )  # fmt: skip
    change = motion @ np.linalg.inv(start)
    right = np.linalg.norm(change[:3, 3]) < REGISTERED_SHIFT and turn_of(change) < REGISTERED_TURN
    # The last number of the weight counts the pixels that correspond.
    if not (found and right and weight[5, 5] > OVERLAP * size[0] * size[1]):
        return None
    return motion.round(DIGITS), weight.round()


def _thumbnail(grey: NDArray[Any]) -> NDArray[np.float64]:
    """A grey picture's small copy as a row of zero mean and unit length."""
    import cv2

    small = cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA)
    row = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float64).ravel()
    row -= row.mean()
    return row / max(float(np.linalg.norm(row)), 1e-9)


def _reduced_size(width: int, height: int, *, side: int) -> tuple[int, int]:
    scale = min(1.0, side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _centre_origin(K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intrinsics whose first pixel centre is (0.5, 0.5), moved to (0, 0)."""
    moved = K.copy()
    moved[:2, 2] -= 0.5
    return moved
