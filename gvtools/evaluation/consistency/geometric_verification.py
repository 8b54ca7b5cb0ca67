"""Geometric verification: do the pictures match one another, and do they fit the requested poses?

COLMAP's own steps, on the CPU: SIFT features, exhaustive matching, verification of each pair by a
two-view geometry that is estimated from the matches alone, and triangulation with the requested
poses and intrinsics held fixed. Needs no depth. Three readings, to be taken together:

- how many matches were verified: whether the pictures show one rigid scene at all;
- their epipolar distance under the requested poses: whether it was seen from there. Nothing is
  filtered by the poses, so it grows with the pose error. It does not see errors along the epipolar
  lines, such as the length of a baseline;
- the triangulation: its reprojection error, and the share of verified matches it took in.

A triangulation filter hides wrong poses. At COLMAP's own error limits (4 pixels, 2 degrees),
turning one of five photographs of 7-Scenes by 3 degrees *lowers* the mean reprojection error, from
0.89 to 0.82 pixels, because the matches that tell are discarded. The limit here is wide instead
(``REPROJECTION_LIMIT``: then 0.90 and 4.1 pixels), and what is still discarded shows in the
triangulated share.

This is not the reprojection error of DROID-SLAM as WorldScore computes it (optical-flow residuals
after bundle adjustment of estimated poses), which is probably what tables of generated views call
"Reproj."; the numbers do not compare.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvtools.cameras import Cameras, Float64, concatenate, invert_rigid
from gvtools.errors import ProjectError, ShapeError
from gvtools.evaluation.consistency.colmap_matching import (
    MIN_MATCHES,
    Matched,
    match_pictures,
    observed_points,
    triangulate,
)
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.features import quiet_colmap

if TYPE_CHECKING:
    import pycolmap

# Largest reprojection error of a triangulated observation, as a share of the longest picture side:
# 32 of 640 pixels, 3 to 4 degrees of an ordinary lens.
REPROJECTION_LIMIT = 0.05
# Pixels; what COLMAP verifies matches with, at a geometry of their own.
EPIPOLAR_LIMIT = 4.0
# Centres nearer than this share of their extent, or of their distance from the origin, which
# rounding moves them by, have no epipolar geometry.
COINCIDENT = 1e-6
ROUNDING = 1e-12


@dataclass(frozen=True)
class PairVerification:
    """Two pictures with verified matches.

    Attributes:
        first: name of a view.
        second: name of the other.
        verified: matches that a two-view geometry of their own agrees with.
        triangulated: of these, those whose two ends observe one triangulated point.
        epipolar: median symmetric epipolar distance of the verified matches under the requested
            poses, pixels; None where both cameras have one centre.
    """

    first: str
    second: str
    verified: int
    triangulated: int
    epipolar: float | None


@dataclass(frozen=True)
class GeometricVerification:
    """What COLMAP makes of the pictures at the requested poses. None stands for no figure.

    Attributes:
        status: "triangulated", or "empty: ..." with the reason why there is no point.
        images: pictures given.
        pairs: those with verified matches.
        mean_features: SIFT features per picture.
        mean_verified: verified matches per pair, over all pairs, matched or not.
        verified_share: of the pictures, those in a pair with at least 15 verified matches.
        epipolar: median symmetric epipolar distance of all verified matches under the requested
            poses, pixels. A single wrong view moves it little: read the pairs.
        epipolar_inlier_share: of the verified matches, those within 4 pixels of that distance.
        triangulated_share: of the verified matches.
        registered_share: of the pictures, those that observe triangulated points.
        unregistered: names of the other pictures.
        points: triangulated points.
        mean_track_length: observations per point.
        mean_reprojection: of the triangulated points at the requested poses, pixels.
        reprojection_limit: observations beyond it were left out of the triangulation, pixels.
    """

    status: str
    images: int
    pairs: tuple[PairVerification, ...]
    mean_features: float | None
    mean_verified: float | None
    verified_share: float | None
    epipolar: float | None
    epipolar_inlier_share: float | None
    triangulated_share: float | None
    registered_share: float | None
    unregistered: tuple[str, ...]
    points: int
    mean_track_length: float | None
    mean_reprojection: float | None
    reprojection_limit: float

    @property
    def ok(self) -> bool:
        """Whether anything could be triangulated."""
        return self.status == "triangulated"


def verify_geometry(
    pictures: Sequence[PosedPicture], *, workspace: Path | None = None, seed: int = 0
) -> GeometricVerification:
    """Match the pictures with one another and triangulate with their poses fixed.

    Runs on one thread, so that equal pictures and seed give equal figures. Time grows with the
    number of pairs. Features where a picture's mask is False are not used.

    Args:
        pictures: the views; depth is not used.
        workspace: a new or empty folder for the pictures, database and model, which are kept; None
            uses a temporary folder.
        seed: of the random sampling in verification and triangulation, 0 or more.
    """
    for picture in pictures:
        skew = float(picture.camera.K[0, 0, 1])
        if abs(skew) > 1e-9 * float(picture.camera.K[0, 0, 0]):
            raise ShapeError(
                f"picture {picture.name}: a camera with skew {skew:.6g}; expected 0, COLMAP's "
                "PINHOLE has none; resample the picture"
            )
    if workspace is None:
        with tempfile.TemporaryDirectory(prefix="gvtools-") as folder:
            return _verify(pictures, Path(folder), seed)
    workspace.mkdir(parents=True, exist_ok=True)
    if any(workspace.iterdir()):
        raise ProjectError(f"{workspace} is not empty; expected a new folder; name another")
    return _verify(pictures, workspace, seed)


def epipolar_distances(first: Cameras, second: Cameras, places: tuple[Float64, Float64]) -> Float64:
    """Distances of matched places to each other's epipolar lines, the mean of both, pixels.

    The lines are those of F = K₂⁻ᵀ [t]ₓ R K₁⁻¹ (Hartley and Zisserman, Multiple View Geometry, 2nd
    edition, eq. 9.12).

    Args:
        first: a batch of one.
        second: a batch of one, with another centre.
        places: (M, 2) and (M, 2), pixels of the first and of the second picture.

    Returns:
        (M,) float64.
    """
    move = second.cam_from_world[0] @ invert_rigid(first.cam_from_world[0])
    x, y, z = move[:3, 3] / np.linalg.norm(move[:3, 3])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ move[:3, :3]
    fundamental = np.linalg.inv(second.K[0]).T @ essential @ np.linalg.inv(first.K[0])
    a, b = (np.insert(xy, 2, 1, axis=1) for xy in places)
    in_second, in_first = a @ fundamental.T, b @ fundamental
    algebraic = np.abs((b * in_second).sum(1))
    distance = np.zeros(len(a))
    for lines in (in_second, in_first):
        length = np.linalg.norm(lines[:, :2], axis=1)
        # The epipole has no line: every place agrees with it.
        distance += np.divide(algebraic, length, out=np.zeros(len(a)), where=length > 0) / 2
    return distance


def _verify(pictures: Sequence[PosedPicture], folder: Path, seed: int) -> GeometricVerification:
    side = max((max(picture.rgb.shape[:2]) for picture in pictures), default=0)
    limit = REPROJECTION_LIMIT * side
    matched = Matched(tuple(np.zeros((0, 2)) for _ in pictures))
    distances: list[Float64] = []
    model = None
    if len(pictures) > 1:
        with quiet_colmap():
            matched = match_pictures(pictures, folder, seed=seed)
            distances = _distances(pictures, matched)
            if any(map(len, distances)):
                model = triangulate(pictures, matched, folder, limit=limit, seed=seed)
    return _summary(pictures, matched, distances, model=model, limit=limit)


def _summary(
    pictures: Sequence[PosedPicture],
    matched: Matched,
    distances: Sequence[Float64],
    *,
    model: pycolmap.Reconstruction | None,
    limit: float,
) -> GeometricVerification:
    count = len(pictures)
    possible = count * (count - 1) // 2
    observed = observed_points(model, matched)
    pairs = []
    for pair, distance in zip(matched.pairs, distances, strict=True):
        point = observed[pair.i][pair.rows[:, 0]]
        common = (point >= 0) & (point == observed[pair.j][pair.rows[:, 1]])
        first, second = pictures[pair.i].name, pictures[pair.j].name
        pairs.append(
            PairVerification(first, second, len(pair.rows), int(common.sum()), _median(distance))
        )
    verified = sum(pair.verified for pair in pairs)
    connected = {number for pair in matched.pairs for number in (pair.i, pair.j)}
    registered = [bool((points >= 0).any()) for points in observed]
    every = np.concatenate([np.zeros(0), *distances])
    points = model.num_points3D() if model else 0
    return GeometricVerification(
        status=_status(count, matched, points=points, apart=bool(every.size)),
        images=count,
        pairs=tuple(pairs),
        mean_features=_share(sum(map(len, matched.keypoints)), count if possible else 0),
        mean_verified=_share(verified, possible),
        verified_share=_share(len(connected), count if possible else 0),
        epipolar=_median(every),
        epipolar_inlier_share=_share(int((every <= EPIPOLAR_LIMIT).sum()), len(every)),
        triangulated_share=_share(sum(pair.triangulated for pair in pairs), verified),
        registered_share=_share(sum(registered), count if possible else 0),
        unregistered=tuple(
            picture.name for picture, seen in zip(pictures, registered, strict=True) if not seen
        ),
        points=points,
        mean_track_length=model.compute_mean_track_length() if model and points else None,
        mean_reprojection=model.compute_mean_reprojection_error() if model and points else None,
        reprojection_limit=limit,
    )


def _distances(pictures: Sequence[PosedPicture], matched: Matched) -> list[Float64]:
    """Per pair the epipolar distances of its matches; none where both centres are one."""
    if not matched.pairs:
        return []
    centers = concatenate([picture.camera for picture in pictures]).centers
    extent = np.linalg.norm(np.ptp(centers, axis=0))
    near = max(COINCIDENT * extent, ROUNDING * np.abs(centers).max())
    distances = []
    for pair in matched.pairs:
        if np.linalg.norm(centers[pair.i] - centers[pair.j]) <= near:
            distances.append(np.zeros(0))
            continue
        places = (
            matched.keypoints[pair.i][pair.rows[:, 0]],
            matched.keypoints[pair.j][pair.rows[:, 1]],
        )
        cameras = pictures[pair.i].camera, pictures[pair.j].camera
        distances.append(epipolar_distances(*cameras, places))
    return distances


def _status(count: int, matched: Matched, *, points: int, apart: bool) -> str:
    if points:
        return "triangulated"
    if count < 2:
        return f"empty: {count} picture(s); at least 2 are needed"
    if not matched.pairs:
        features = sum(map(len, matched.keypoints))
        return (
            f"empty: no pair of the {count} pictures ({features} features) has {MIN_MATCHES} "
            "verified matches"
        )
    verified = sum(len(pair.rows) for pair in matched.pairs)
    if not apart:
        return f"empty: {verified} verified matches, but none between cameras with two centres"
    return f"empty: none of the {verified} verified matches could be triangulated at the poses"


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _median(values: Float64) -> float | None:
    return float(np.median(values)) if values.size else None
