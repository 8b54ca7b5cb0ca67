"""Refined poses of views with depth: from odometry, checked by what views predict of each other.

Poses that come from a tracker err by centimetres and tenths of degrees. Pairs of views that overlap
tell their relative pose far better, by colour and depth together. A pose graph finds the poses that
agree with all pairs best; as a whole they are put where the given ones are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from kornia.filters import gaussian_blur2d
from numpy.typing import NDArray

from gvtools.cameras import Float64, reduced_size
from gvtools.o3d import o3d
from gvtools.poses.motions import (
    Pair,
    mean_near,
    motions_between,
    move_pose,
    nearest,
    nearest_pairs,
    optimise,
    turn_of,
)
from gvtools.similarity import align_poses

# Odometry compares pictures at this length of the longer side [px], each with so many neighbours.
SIDE, ODOMETRY_NEIGHBOURS = 320, 3
# Neighbours along the path keep their given relative pose by this share of a pair's weight, so that
# views that overlap with none stay where they were.
GIVEN_WEIGHT = 0.01
# Refined poses are kept if the error of predicting neighbouring photographs falls by this share.
LEAST_BETTER = 0.01
# Photographs are predicted at one over this of their size, each from so many neighbours, by one of
# so many pixels.
SMALLER, PREDICTED_FROM, PIXELS = 2, 2, 4
# With fewer of these inside, a pair does not count.
FEWEST = 25
# Odometry works on depth scaled to TYPICAL_DEPTH: Open3D's limits are metres for rooms. Points
# farther apart than REGISTERED_APART do not belong together [scaled depth].
TYPICAL_DEPTH, REGISTERED_APART = 2.0, 0.03
# More than any scaled depth.
BEYOND = 1e3
# A pair counts when this share of a picture overlaps, and moves by less than this [scaled depth,
# rad] from the given poses: more is not a tracker's error but a comparison that went wrong.
OVERLAP, REGISTERED_SHIFT, REGISTERED_TURN = 0.1, 0.12, 0.07
# Steps at half and all of the size.
REGISTERED_ITERATIONS = (10, 5)
# Its relative poses are rounded to so many digits, as threads add in any order.
DIGITS = 9
# Reduced pictures are no smaller than this [px].
SMALLEST = 16


@dataclass(frozen=True, eq=False)
class FitView:
    """One photograph (H, W, 3), its intrinsics [px] and its pose in a local frame."""

    rgb: NDArray[np.uint8]
    K: NDArray[np.float64]
    cam_from_local: NDArray[np.float64]
    # (H, W), True = use; None uses all.
    mask: NDArray[np.bool_] | None = None
    # (H, W) recorded z-depth, scene units, 0 = none.
    depth: NDArray[np.float32] | None = None
    # Likewise, estimated by a network and wrong by some percent.
    estimate: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class ReducedView:
    """A photograph at one size, and the intrinsics of this size."""

    # (3, H, W) colours from 0 to 1.
    target: NDArray[np.float32]
    # (H, W) the share of each pixel that is used.
    weight: NDArray[np.float32]
    depth: NDArray[np.float32] | None
    estimate: NDArray[np.float32] | None
    K: NDArray[np.float64]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.target.shape[2], self.target.shape[1]

    @property
    def nbytes(self) -> int:
        """Of all arrays."""
        arrays = (self.target, self.weight, self.depth, self.estimate)
        return sum(array.nbytes for array in arrays if array is not None)


def reduce_view(view: FitView, factor: int) -> ReducedView:
    """A view at one over ``factor`` of its size; colours are means, depth is picked.

    Of colours only those that the mask lets through count.
    """
    height, width = view.rgb.shape[:2]
    rows, columns = max(height // factor, SMALLEST), max(width // factor, SMALLEST)
    if factor == 1:
        rows, columns = height, width
    target = torch.from_numpy(view.rgb).permute(2, 0, 1).float() / 255
    mask = np.ones((height, width), np.float32) if view.mask is None else view.mask
    weight = torch.from_numpy(np.asarray(mask, np.float32))[None]
    both = torch.cat([target * weight, weight])
    if (rows, columns) != (height, width):
        both = torch.nn.functional.interpolate(both[None], (rows, columns), mode="area")[0]
    depth, estimate = (
        None if full is None else _pick(full, rows, columns) for full in (view.depth, view.estimate)
    )
    K = view.K.copy()
    K[0] *= columns / width
    K[1] *= rows / height
    arrays = both.contiguous().numpy()
    if view.mask is not None:
        arrays[:3] /= np.maximum(arrays[3], np.float32(1e-6))
    return ReducedView(arrays[:3], arrays[3], depth, estimate, K)


def _pick(depth: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """The pixels of (H, W) depth that are nearest to those of a smaller picture."""
    height, width = depth.shape
    if (rows, columns) == (height, width):
        return depth
    y = ((np.arange(rows) + 0.5) * height / rows).astype(int)
    x = ((np.arange(columns) + 0.5) * width / columns).astype(int)
    return np.ascontiguousarray(depth[y][:, x])


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """Poses (V, 4, 4) camera from world on which views agree, beside those that they were given."""

    given: Float64
    poses: Float64
    # Typical, scene units.
    depth: float
    # Whether other cameras err like the views near them.
    spread: bool
    # By given and by refined poses: mean difference of colours between neighbouring views where
    # they show the same, 0 to 1, or what features miss, pixels.
    errors: tuple[float, float]
    # Whether features told the poses, to a fraction of a pixel: a fit leaves them.
    by_features: bool = False
    # The unit of ``errors``.
    in_pixels: bool = False

    @property
    def motions(self) -> Float64:
        """(V, 6) shift and turn from the given pose to the refined one, on the camera's side."""
        return motions_between(self.given, self.poses)

    def corrected(self, pose: Float64) -> Float64:
        """(4, 4) another camera's pose, moved as the views near it were if ``spread``."""
        if not self.spread:
            return pose
        return move_pose(pose, mean_near(pose, self.given, self.motions, depth=self.depth))

    def like_neighbours(self) -> Float64:
        """(V, 4, 4) each given pose, moved as the views near it were."""
        motions = self.motions
        return np.stack([
            move_pose(pose, mean_near(pose, self.given, motions, depth=self.depth, but=[row]))
            for row, pose in enumerate(self.given)
        ])  # fmt: skip

    def __str__(self) -> str:
        shift = np.median(np.linalg.norm(self.motions[:, :3], axis=1))
        turn = np.degrees(np.median(np.linalg.norm(self.motions[:, 3:], axis=1)))
        before, after = self.errors
        told = f"neighbouring views differ by {after:.4f} instead of {before:.4f}"
        if self.in_pixels:
            told = f"features miss them by {after:.2f} instead of {before:.2f} px"
        return f"moved by {shift:.3g} scene units and {turn:.2f} degrees (medians); {told}" + (
            "; targets moved like the context near them" if self.spread else ""
        )


def refined_poses(views: Sequence[FitView], poses: Float64 | None = None) -> RefinedPoses | None:
    """Poses on which neighbouring views agree; None where the given ones are as good.

    All views have depth and are in the order of the path; ``poses`` (V, 4, 4) are told by features,
    None finds some by odometry.
    """
    if len(views) < 2:
        return None
    given = np.stack([view.cam_from_local for view in views])
    by_features = poses is not None
    if poses is None:
        poses = agreeing_poses(views)
    small = comparable(views)
    before, after = prediction_error(small, given), prediction_error(small, poses)
    if not after < before * (1 - LEAST_BETTER):
        return None
    depth = np.concatenate([view.depth[::8, ::8].ravel() for view in views])  # type: ignore[index]
    typical = float(np.median(depth[depth > 0]))
    refined = RefinedPoses(given, poses, typical, False, (before, after), by_features)
    # Each view is once treated as another camera: does it look more like its refined neighbours
    # where it was given, or moved as they were?
    near = prediction_error(small, poses, at=refined.like_neighbours())
    away = prediction_error(small, poses, at=given)
    spread = near < away * (1 - LEAST_BETTER)
    return replace(refined, spread=spread)


def agreeing_poses(views: Sequence[FitView]) -> Float64:
    """(V, 4, 4) refined ``cam_from_local``, on average where they were given."""
    height, width = views[0].rgb.shape[:2]
    size = reduced_size(width, height, SIDE)
    smaller = [np.diag([*(np.array(size) / view.rgb.shape[1::-1]), 1]) for view in views]
    K = np.median([a @ view.K for a, view in zip(smaller, views, strict=True)], axis=0)
    K[0, 1] = 0  # Open3D knows no skew; views that have some are warped
    depths = [_depth(view)[::8, ::8] for view in views]
    known = np.concatenate([depth[depth > 0] for depth in depths])
    if not len(known):
        return np.stack([view.cam_from_local for view in views])
    unit = np.diag([1.0, 1.0, 1.0, TYPICAL_DEPTH / np.median(known)])
    given = [np.linalg.inv(unit) @ view.cam_from_local @ unit for view in views]
    images = [_image(view, K, size, scale=TYPICAL_DEPTH / np.median(known)) for view in views]
    refined = _optimise(np.stack(given), images, K, size=size)
    moved = refined @ align_poses(refined, np.stack(given))
    return np.asarray(unit @ moved @ np.linalg.inv(unit))


def _optimise(
    given: Float64, images: list[o3d.geometry.RGBDImage], K: Float64, *, size: tuple[int, int]
) -> Float64:
    """(V, 4, 4) poses that agree with the pairs of images; pairs that contradict are left out."""
    pairs = []
    for i, j in nearest_pairs(given, count=ODOMETRY_NEIGHBOURS, shift=TYPICAL_DEPTH, by_angle=True):
        start = given[j] @ np.linalg.inv(given[i])
        measured = _register((images[i], images[j]), K, size=size, start=start)
        if measured is not None:
            pairs.append(Pair(i, j, *measured, uncertain=True))
    if not pairs:
        return given
    weight = GIVEN_WEIGHT * float(np.median([pair.information[5, 5] for pair in pairs]))
    for row in range(len(given) - 1):
        motion = given[row + 1] @ np.linalg.inv(given[row])
        pairs.append(Pair(row, row + 1, motion, weight * np.eye(6), uncertain=False))
    poses = optimise({row: np.linalg.inv(pose) for row, pose in enumerate(given)}, pairs)
    return np.stack([np.linalg.inv(pose) for pose in poses.values()])


def _register(
    both: Sequence[o3d.geometry.RGBDImage], K: Float64, *, size: tuple[int, int], start: Float64
) -> tuple[Float64, Float64] | None:
    """The second image's pose (4, 4) from the first, and its information matrix (6, 6), or None.

    Open3D's older odometry is half as fast as that of recordings; it starts from poses that are
    nearly right, and gives, but for a rare case, the same every time.
    """
    odometry = o3d.pipelines.odometry
    # Open3D counts pixels from the first one's centre.
    intrinsics = o3d.camera.PinholeCameraIntrinsic(
        *size, K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5
    )
    found, motion, weight = odometry.compute_rgbd_odometry(
        *both, intrinsics, start, odometry.RGBDOdometryJacobianFromHybridTerm(),
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


def _depth(view: FitView) -> NDArray[np.float32]:
    assert view.depth is not None
    return view.depth if view.mask is None else view.depth * view.mask


def _image(
    view: FitView, K: Float64, size: tuple[int, int], *, scale: float
) -> o3d.geometry.RGBDImage:
    """A view as a camera that all views share sees it, with scaled depth."""
    # Pixels count from the first one's corner in ``K``, from its centre in OpenCV.
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    smaller = (np.linalg.inv(shift) @ K @ np.linalg.inv(view.K) @ shift)[:2]
    blur = 0.4 / smaller[0, 0]
    rgb = cv2.GaussianBlur(view.rgb, (0, 0), blur) if blur > 0.5 else view.rgb
    rgb = cv2.warpAffine(
        rgb, smaller, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    depth = cv2.warpAffine(
        (_depth(view) * scale).astype(np.float32), smaller, size, flags=cv2.INTER_NEAREST
    )
    return o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(np.ascontiguousarray(rgb)),
        o3d.geometry.Image(np.ascontiguousarray(depth)),
        depth_scale=1.0,
        depth_trunc=BEYOND,
        convert_rgb_to_intensity=True,
    )


def comparable(views: Sequence[FitView]) -> list[ReducedView]:
    """Views as ``prediction_error`` compares them: smaller, without their noise.

    Looking up between pixels would average it away, so that poses seemed better by which pictures
    meet between pixels.
    """
    found = []
    for view in views:
        small = reduce_view(view, SMALLER)
        smooth = gaussian_blur2d(torch.from_numpy(small.target)[None], (5, 5), (1.0, 1.0))
        found.append(replace(small, target=smooth[0].numpy()))
    return found


def prediction_error(
    small: Sequence[ReducedView], poses: Float64, *, at: Float64 | None = None
) -> float:
    """Mean over pairs of neighbouring photographs of the median colour difference, 0 to 1.

    Each pixel with depth is looked up in the neighbour; what is hidden there is a minority that the
    median passes over. NaN where no pair overlaps. ``small``: at least two, see ``comparable``;
    ``at`` is where each camera is when it is compared with the others; None: at its pose.
    """
    at = poses if at is None else at
    depths = np.concatenate([view.depth.ravel() for view in small if view.depth is not None])
    known = depths[depths > 0]
    typical = float(np.median(known)) if len(known) else 1.0
    errors = []
    for row, view in enumerate(small):
        assert view.depth is not None
        for other in nearest(poses, row, count=PREDICTED_FROM, shift=typical):
            y, x = (each[::PIXELS] for each in np.nonzero((view.depth > 0) & (view.weight > 0.5)))
            rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]).T @ np.linalg.inv(view.K).T
            points = rays * view.depth[y, x, None]
            motion = poses[other] @ np.linalg.inv(at[row])
            points = points @ motion[:3, :3].T + motion[:3, 3]
            found, inside = _look_up(small[other].target, points, small[other].K)
            if inside.sum() > FEWEST:
                errors.append(float(np.median(np.abs(found - view.target[:, y, x])[:, inside])))
    return float(np.mean(errors)) if errors else float("nan")


def _look_up(
    picture: NDArray[np.float32], points: Float64, K: Float64
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Colours (3, N) of a picture at points of its camera's frame, and which lie inside."""
    height, width = picture.shape[1:]
    ahead = points[:, 2] > 0
    xy = points @ K.T
    xy = xy[:, :2] / np.where(ahead, xy[:, 2], 1)[:, None]
    inside = ahead & (xy > 0).all(axis=1) & (xy < [width, height]).all(axis=1)
    grid = torch.from_numpy((xy / [width, height] * 2 - 1).astype(np.float32))[None, None]
    colors = torch.nn.functional.grid_sample(
        torch.from_numpy(picture)[None], grid, padding_mode="border", align_corners=False
    )
    return colors[0, :, 0].numpy(), inside
