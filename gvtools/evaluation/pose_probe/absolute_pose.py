"""The camera pose that most 2D-3D matches agree on, and whether another one competes with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Float64

LEAST = 4  # matches: three leave up to four poses
# Matches within this many times the error of a pose are near to it: their own pose is no rival.
NEAR = 3.0
# A pose contradicts another beyond this rotation, or this share of the depth of what it sees.
# Recorded poses of one real scene that do not quite agree give rivals up to 4 degrees and 9 % off.
ROTATION_DEG = 10.0
DEPTH_SHARE = 0.25
RIVALS = 3  # looked at: near ones may come first


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """A pose, and the matches that support it.

    Attributes:
        cam_from_world: (4, 4) float64, rigid, scene units.
        inliers: (M,) bool, matches within the error of this very pose.
        rms: root mean square of the inliers' reprojection errors, pixels.
    """

    cam_from_world: Float64
    inliers: NDArray[np.bool_]
    rms: float


def absolute_pose(
    xy: Float64,
    points: Float64,
    K: Float64,
    *,
    max_error: float,
    seed: int = 0,
    min_inlier_share: float = 0.1,
) -> AbsolutePose | None:
    """Estimate by LO-RANSAC over P3P, refine over all inliers, and count those of the result.

    Args:
        xy: (M, 2), pixels; the first pixel's centre is (0.5, 0.5).
        points: (M, 3), world frame, scene units.
        K: (3, 3), pixels.
        max_error: reprojection error of an inlier, pixels.
        seed: of the sampling.
        min_inlier_share: samples are drawn until a pose of this share would have been met; below
            0.1 there are at most 10,000.

    Returns:
        The pose; None when no four matches agree on one.
    """
    import pycolmap

    if len(xy) < LEAST:
        return None
    # COLMAP's pinhole has no skew, and coordinates near 0 keep their digits.
    pinhole = np.column_stack([xy[:, 0] - K[0, 1] * (xy[:, 1] - K[1, 2]) / K[1, 1], xy[:, 1]])
    origin = points.mean(axis=0)
    # The picture's size plays no part.
    camera = pycolmap.Camera(
        model="PINHOLE", width=1, height=1, params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    )
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = max_error
    estimation.ransac.random_seed = seed
    estimation.ransac.min_inlier_ratio = min_inlier_share
    found = pycolmap.estimate_and_refine_absolute_pose(pinhole, points - origin, camera, estimation)
    if found is None:
        return None
    cam_from_world = np.eye(4)
    cam_from_world[:3] = found["cam_from_world"].matrix()
    errors = _reprojection_errors(cam_from_world, xy, points - origin, K=K)
    inliers = errors <= max_error
    if inliers.sum() < LEAST:
        return None
    cam_from_world[:3, 3] -= cam_from_world[:3, :3] @ origin
    return AbsolutePose(cam_from_world, inliers, float(np.sqrt(np.mean(errors[inliers] ** 2))))


def rival_pose(
    xy: Float64,
    points: Float64,
    K: Float64,
    *,
    pose: AbsolutePose,
    max_error: float,
    share: float,
    seed: int = 0,
) -> AbsolutePose | None:
    """The best pose that contradicts ``pose``, if about ``share`` of its inliers support one.

    Repeated and symmetric things give such poses: a rug that looks the same from both ends, two
    chairs of one kind, pictures put together from pieces.

    Args:
        xy: (M, 2), pixels.
        points: (M, 3), world frame, scene units.
        K: (3, 3), pixels.
        pose: of these matches.
        max_error: reprojection error of an inlier, pixels.
        share: of the inliers of ``pose``; rivals with far fewer are not looked for.
        seed: of the sampling.

    Returns:
        The rival, its inliers as (M,) bool; None when there is none.
    """
    wanted = share * int(pose.inliers.sum())
    depth = float(np.median((points[pose.inliers] @ pose.cam_from_world[:3, :3].T)[:, 2]))
    depth += pose.cam_from_world[2, 3]
    known, rest = pose, np.ones(len(xy), np.bool_)
    for _ in range(RIVALS):
        rest &= _reprojection_errors(known.cam_from_world, xy, points, K=K) > NEAR * max_error
        if rest.sum() < max(wanted, LEAST):
            return None
        # Half of the wanted share: matches are counted here, not the places they come from.
        found = absolute_pose(
            xy[rest],
            points[rest],
            K,
            max_error=max_error,
            seed=seed,
            min_inlier_share=min(0.5 * wanted / int(rest.sum()), 0.9),
        )
        if found is None:
            return None
        inliers = np.zeros(len(xy), np.bool_)
        inliers[rest] = found.inliers
        known = AbsolutePose(found.cam_from_world, inliers, found.rms)
        if _contradicts(known.cam_from_world, pose.cam_from_world, depth):
            return known
    return None


def angle_deg(first: Float64, second: Float64) -> float:
    """Angle between two (3, 3) orientations; |A − B| = 2 √2 sin(angle / 2), exact near 0."""
    chord = np.linalg.norm(first - second) / (2 * np.sqrt(2))
    return float(np.degrees(2 * np.arcsin(min(1.0, float(chord)))))


def center_distance(first: Float64, second: Float64) -> float:
    """Distance between the centres of two (4, 4) cam_from_world, scene units."""
    centers = [-pose[:3, :3].T @ pose[:3, 3] for pose in (first, second)]
    return float(np.linalg.norm(centers[0] - centers[1]))


def _contradicts(first: Float64, second: Float64, depth: float) -> bool:
    turned = angle_deg(first[:3, :3], second[:3, :3]) > ROTATION_DEG
    return turned or center_distance(first, second) > DEPTH_SHARE * depth


def _reprojection_errors(pose: Float64, xy: Float64, points: Float64, *, K: Float64) -> Float64:
    """(M,) pixels; infinite behind the camera."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    ahead = local[:, 2] > 0
    z = np.where(ahead, local[:, 2], 1)
    projected = (local @ K.T)[:, :2] / z[:, None]
    return np.where(ahead, np.linalg.norm(projected - xy, axis=1), np.inf)
