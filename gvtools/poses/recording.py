"""Poses of an RGB-D recording: odometry of pairs of frames, loop closures, and a pose graph.

Nothing is known of the poses. A pair of frames is registered by Open3D's hybrid odometry (colour
and depth), then refined by point-to-plane odometry (depth alone) if the depth map constrains all
six degrees of freedom. Depth cameras do not take colour and depth at quite the same time, which
hybrid odometry turns into pose errors (7-Scenes' kitchen, 40 frames in a row: 7.5 mm with hybrid
odometry alone, 2.7 mm with both; every tenth frame: 38 mm and 26 mm). A flat wall leaves
point-to-plane odometry free to slide; there the result of hybrid odometry stays. Open3D's tensor
odometry sums in the order of its threads: results differ in the fifth digit between runs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Float64, invert_rigid, reduced_size, rigid_poses
from gvtools.features import mutual_nearest, root_sift
from gvtools.poses.motions import Pair, optimise, turn_of, within
from gvtools.scenes.scene import Scene

if TYPE_CHECKING:
    from open3d.t.geometry import RGBDImage

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
# Greater depths than FARTHEST are not used, nor greater ones than CLOSE in frames with at least
# CLOSE_SHARE of their depth below it [m]: a depth camera's error grows with the square of the
# distance (every tenth frame of 7-Scenes' kitchen: position errors of 26 mm, 37 mm without).
CLOSE, CLOSE_SHARE, FARTHEST = 2.5, 0.5, 5.0
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
# Neighbours whose agreement is below this are registered from other initial poses, too: at a wrong
# local minimum two thirds of the pixels can agree.
SURE = 0.9
# Every n-th frame is also registered to the one n before it.
GAPS = (2, 4, 8, 16, 32)
# A new keyframe after so much motion since the last one [m, degrees].
KEY_SHIFT, KEY_TURN = 0.08, 5.0
# Loop closures are tried between a keyframe and the ALIKE others that look most like it, and the
# NEAR ones of nearest pose,
ALIKE, NEAR = 6, 4
# of those within this [m, degrees].
NEAR_SHIFT, NEAR_TURN = 0.6, 30.0
# How often loops by pose are looked for, each time with the poses optimised so far.
ROUNDS = 2


class SmallFrame(NamedTuple):
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
        # (3, 3) at the reduced size and of the features' pixels.
        self._size, self.K = _reduced(scene, SIDE)
        self._feature_size, self.feature_K = _reduced(scene, FEATURE_SIDE)
        self.frame = lru_cache(CACHED)(self._load)
        # All are kept in memory, so ask for keyframes alone.
        self.features = cache(self._find)

    def __len__(self) -> int:
        return len(self.scene)

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

    def _find(self, index: int) -> FrameFeatures:
        import cv2

        frame = self.scene.views[index].load()
        assert frame.depth is not None
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, self._feature_size, interpolation=cv2.INTER_AREA)
        depth = cv2.resize(frame.depth, self._feature_size, interpolation=cv2.INTER_NEAREST)
        keypoints, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(grey, None)
        small = cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA)
        thumbnail = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float64).ravel()
        thumbnail -= thumbnail.mean()
        thumbnail /= max(float(np.linalg.norm(thumbnail)), 1e-9)
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

    first, second = frames.frame(source), frames.frame(target)
    method = o3d.t.pipelines.odometry.Method
    known = first.depth[(first.depth > 0) & (first.depth < FARTHEST)]
    close = (known < CLOSE).sum() >= CLOSE_SHARE * max(1, known.size)
    reach = CLOSE if close else FARTHEST
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
    z = first[::STEP, ::STEP].astype(np.float64)
    line, column = np.nonzero((z > 0) & (z <= FARTHEST))
    z = z[line, column]
    x, y = (column * STEP - K[0, 2]) / K[0, 0] * z, (line * STEP - K[1, 2]) / K[1, 1] * z
    points = np.stack([x, y, z], axis=-1)
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


def start_from_features(frames: RgbdFrames, first: int, second: int) -> Float64 | None:
    """An initial ``second_from_first`` by matched SIFT and perspective-n-point with RANSAC.

    None where too few matches agree.
    """
    import cv2

    source, target = frames.features(first), frames.features(second)
    known = np.nonzero(np.isfinite(source.points[:, 2]))[0]
    if min(len(known), len(target.pixels)) < LEAST_INLIERS:
        return None
    rows = mutual_nearest(source.descriptors[known], target.descriptors, ratio=RATIO)
    if len(rows) < LEAST_INLIERS:
        return None
    cv2.setRNGSeed(1)
    try:
        found, turn, shift, inliers = cv2.solvePnPRansac(
            source.points[known[rows[:, 0]]], target.pixels[rows[:, 1]].astype(np.float64),
            frames.feature_K, None, iterationsCount=500, reprojectionError=INLIER_PX,
            flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
    except cv2.error:
        # Degenerate points, such as many in one place.
        return None
    if not found or inliers is None or len(inliers) < LEAST_INLIERS:
        return None
    return rigid_poses(cv2.Rodrigues(turn)[0], shift.ravel())


def _reduced(scene: Scene, side: int) -> tuple[tuple[int, int], Float64]:
    """Width and height of reduced pictures, and K, pixels counting from the first one's centre."""
    camera = scene.views[0].camera
    size = reduced_size(int(camera.width[0]), int(camera.height[0]), side)
    K = camera.resized(*size).K[0].copy()
    K[:2, 2] -= 0.5
    return size, K


Say = Callable[[str], object]


@dataclass(frozen=True, eq=False)
class RecordingPoses:
    """Poses of the largest connected part of a recording."""

    # (4, 4) ``world_from_cam`` by frame, metres; the first frame's is the identity.
    poses: dict[int, Float64]
    # Frames of each connected part, the largest first.
    parts: list[list[int]]
    # All that agreed, and loop closures: those of the largest part that are no neighbours along
    # the path.
    pairs: list[Pair]
    loops: list[Pair]
    # (L, 2) errors of loops [mm, degrees] if neighbouring pairs are simply chained; loops across a
    # break of the chain have no row.
    drift: Float64
    # (loops, 2) their errors after optimisation [mm, degrees].
    residuals: Float64
    keyframes: list[int]


def find_poses(frames: RgbdFrames, *, say: Say = lambda text: None) -> RecordingPoses:
    """Find the poses of frames in order of time; ``say`` gets a line of text at each step."""
    pairs, chain = _along(frames, say)
    keyframes, path = _keyframes(len(frames), chain), set(pairs)
    _loops_alike(frames, keyframes, pairs, say=say)
    for _ in range(ROUNDS):
        poses, before = _solve(len(frames), list(pairs.values())), len(pairs)
        _loops_near(frames, [key for key in keyframes if key in poses], pairs, poses=poses)
        if len(pairs) == before:
            break
    every = list(pairs.values())
    poses = _solve(len(frames), every)
    loops = [
        pair for key, pair in pairs.items()
        if key not in path and {pair.source, pair.target} <= poses.keys()
    ]  # fmt: skip
    residuals = np.array([residual(pair, poses) for pair in loops]).reshape(-1, 2)
    parts = connected_parts(len(frames), every)
    return RecordingPoses(poses, parts, every, loops, _drift(loops, chain), residuals, keyframes)


def _solve(count: int, pairs: list[Pair]) -> dict[int, Float64]:
    """The poses of the largest connected part."""
    part = connected_parts(count, pairs)[0]
    inside = set(part)
    own = sorted(
        (pair for pair in pairs if pair.source in inside),
        key=lambda pair: (abs(pair.source - pair.target), pair.source),
    )
    poses = first_poses(part, own)
    return optimise({frame: poses[frame] for frame in part}, own) if own else poses


def connected_parts(count: int, pairs: Sequence[Pair]) -> list[list[int]]:
    """Parts of the frames that pairs connect, the largest first, each in order."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = [pair.source for pair in pairs], [pair.target for pair in pairs]
    links = coo_matrix((np.ones(len(pairs)), ends), shape=(count, count))
    number, label = connected_components(links, directed=False)
    parts = [np.nonzero(label == part)[0].tolist() for part in range(number)]
    return sorted(parts, key=lambda part: (-len(part), part[0]))


def first_poses(part: Sequence[int], pairs: Sequence[Pair]) -> dict[int, Float64]:
    """``world_from_cam`` of connected frames along as few pairs as possible from the first one.

    Pairs of neighbours in time come before loops.
    """
    near: dict[int, list[tuple[int, Float64]]] = {frame: [] for frame in part}
    for pair in pairs:
        # world_from_source = world_from_target @ target_from_source
        near[pair.target].append((pair.source, pair.target_from_source))
        near[pair.source].append((pair.target, invert_rigid(pair.target_from_source)))
    poses, waiting = {part[0]: np.eye(4)}, deque([part[0]])
    while waiting:
        at = waiting.popleft()
        for other, step in near[at]:
            if other not in poses:
                poses[other] = poses[at] @ step
                waiting.append(other)
    return poses


def residual(pair: Pair, poses: dict[int, Float64]) -> tuple[float, float]:
    """By how much poses in metres depart from a measured pair: millimetres and degrees."""
    predicted = invert_rigid(poses[pair.target]) @ poses[pair.source]
    off = invert_rigid(pair.target_from_source) @ predicted
    return float(np.linalg.norm(off[:3, 3]) * 1e3), float(np.degrees(turn_of(off)))


def _along(frames: RgbdFrames, say: Say) -> tuple[dict[tuple[int, int], Pair], dict[int, Pair]]:
    """Pairs of neighbours in time and of frames farther apart, and the former by their source."""
    pairs: dict[tuple[int, int], Pair] = {}
    chain: dict[int, Pair] = {}
    motion = np.eye(4)
    for at in range(1, len(frames)):
        if at % 100 == 0:
            say(f"{at} of {len(frames)} frames compared")
        pair = _next(frames, at, motion)
        motion = np.eye(4) if pair is None else pair.target_from_source
        if pair is None:
            continue
        pairs[at, at - 1] = chain[at] = pair
        for gap in GAPS:
            start = None if at % gap else _chained(chain, at, at - gap)
            far = None if start is None else compare(frames, at, at - gap, start=start)
            if far is None:
                break
            pairs[at, at - gap] = far
    return pairs, chain


def _chained(chain: dict[int, Pair], source: int, target: int) -> Float64 | None:
    """(4, 4) ``target_from_source`` of an earlier target by neighbours; None across a break."""
    pose = np.eye(4)
    for at in range(source, target, -1):
        if at not in chain:
            return None
        pose = chain[at].target_from_source @ pose
    return pose


def _next(frames: RgbdFrames, at: int, motion: Float64) -> Pair | None:
    """The pair of a frame and the one before it, from the initial pose that gives the best result.

    Tried in this order until one is SURE: the motion before, no motion, and PnP on features.
    """

    def starts() -> Iterator[Float64 | None]:
        yield motion
        if not np.array_equal(motion, np.eye(4)):
            yield np.eye(4)
        yield start_from_features(frames, at, at - 1)

    best: Pair | None = None
    for start in starts():
        pair = None if start is None else compare(frames, at, at - 1, start=start)
        if pair is not None and (best is None or pair.agreement > best.agreement):
            best = pair
        if best is not None and best.agreement >= SURE:
            break
    return best


def _keyframes(count: int, chain: dict[int, Pair]) -> list[int]:
    """Frames after enough motion, and on both sides of each break of the path."""
    keys, pose = [0], np.eye(4)
    for at in range(1, count):
        if at not in chain:
            keys += [at - 1] * (keys[-1] != at - 1) + [at]
            pose = np.eye(4)
            continue
        pose = pose @ chain[at].target_from_source
        if not within(pose, KEY_SHIFT, KEY_TURN):
            keys.append(at)
            pose = np.eye(4)
    if keys[-1] != count - 1:
        keys.append(count - 1)
    return keys


def _loops_alike(
    frames: RgbdFrames, keyframes: list[int], pairs: dict[tuple[int, int], Pair], *, say: Say
) -> None:
    """Add loop closures between keyframes that look alike."""
    say(f"looking for loops among {len(keyframes)} keyframes")
    if len(keyframes) < 2:
        return
    thumbnails = np.stack([frames.features(key).thumbnail for key in keyframes])
    likeness = thumbnails @ thumbnails.T
    np.fill_diagonal(likeness, -np.inf)
    wanted = set()
    for row, key in enumerate(keyframes):
        # Neighbours among keyframes are tried as well: they may lie on two sides of a break.
        near = [other for other in (row - 2, row - 1) if other >= 0]
        alike = np.argsort(-likeness[row], kind="stable")[: min(ALIKE, len(keyframes) - 1)]
        for other in [*near, *alike.tolist()]:
            wanted.add((max(key, keyframes[other]), min(key, keyframes[other])))
    for source, target in sorted(wanted - set(pairs)):
        start = start_from_features(frames, source, target)
        pair = None if start is None else compare(frames, source, target, start=start)
        if pair is not None:
            pairs[source, target] = pair


def _loops_near(
    frames: RgbdFrames,
    keyframes: list[int],
    pairs: dict[tuple[int, int], Pair],
    *,
    poses: dict[int, Float64],
) -> None:
    """Add loop closures between keyframes whose poses are near each other."""
    for row, source in enumerate(keyframes):
        near = []
        for target in keyframes[:row]:
            start = invert_rigid(poses[target]) @ poses[source]
            if (source, target) not in pairs and within(start, NEAR_SHIFT, NEAR_TURN):
                near.append((float(np.linalg.norm(start[:3, 3])), target, start))
        for _, target, start in sorted(near, key=lambda item: item[:2])[:NEAR]:
            pair = compare(frames, source, target, start=start)
            if pair is not None:
                pairs[source, target] = pair


def _drift(loops: list[Pair], chain: dict[int, Pair]) -> Float64:
    """(L, 2) errors [mm, degrees] of loops on chained poses, where the chain has no break."""
    rows = []
    for pair in loops:
        pose = _chained(chain, pair.source, pair.target)
        if pose is not None:
            rows.append(residual(pair, {pair.source: pose, pair.target: np.eye(4)}))
    return np.array(rows).reshape(-1, 2)
