"""Geometric verification: matches of pictures with one another, and their fit to requested poses.

COLMAP's own steps, on the CPU: SIFT features, exhaustive matching, verification of each pair by a
two-view geometry that is estimated from the matches alone, and triangulation with the requested
poses and intrinsics held fixed; one thread, fixed seeds, no depth. Three readings, to be taken
together:

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
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64, concatenate, invert_rigid
from gvtools.errors import ShapeError
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.evaluation.statistics import median_of, share
from gvtools.features import quiet_colmap
from gvtools.poses.colmap import posed_model, row_of, set_intrinsics, write_pictures

if TYPE_CHECKING:
    import pycolmap

# COLMAP's default: fewer inliers do not make a pair.
MIN_MATCHES = 15
# Degrees between rays. COLMAP's 1.5 would leave out near pairs, whose matches still tell.
MIN_TRIANGULATION_ANGLE = 0.2
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
    """Two pictures with verified matches."""

    first: str  # name of a view
    second: str  # name of the other
    verified: int  # matches that a two-view geometry of their own agrees with
    triangulated: int  # of these, those whose two ends observe one triangulated point
    # Median symmetric epipolar distance of the verified matches under the requested poses, pixels;
    # None where both cameras have one centre.
    epipolar: float | None


@dataclass(frozen=True)
class GeometricVerification:
    """What COLMAP makes of the pictures at the requested poses. None stands for no figure."""

    status: str  # "triangulated", or "empty: ..." with the reason why there is no point
    images: int  # pictures given
    pairs: tuple[PairVerification, ...]  # those with verified matches
    mean_features: float | None  # SIFT features per picture
    mean_verified: float | None  # verified matches per pair, over all pairs, matched or not
    # Of the pictures, those in a pair with at least 15 verified matches.
    verified_share: float | None
    # Median symmetric epipolar distance of all verified matches under the requested poses, pixels.
    # A single wrong view moves it little: read the pairs.
    epipolar: float | None
    # Of the verified matches, those within 4 pixels of that distance.
    epipolar_inlier_share: float | None
    triangulated_share: float | None  # of the verified matches
    registered_share: float | None  # of the pictures, those that observe triangulated points
    unregistered: tuple[str, ...]  # names of the other pictures
    points: int  # triangulated points
    mean_track_length: float | None  # observations per point
    mean_reprojection: float | None  # of the triangulated points at the requested poses, pixels
    reprojection_limit: float  # observations beyond it were left out of the triangulation, pixels

    @property
    def ok(self) -> bool:
        """Whether anything could be triangulated."""
        return self.status == "triangulated"


def verify_geometry(
    pictures: Sequence[PosedPicture], *, workspace: Path | None = None, seed: int = 0
) -> GeometricVerification:
    """Match the pictures with one another and triangulate with their poses fixed.

    Equal pictures and seed give equal figures. Time grows with the number of pairs. Features where
    a picture's mask is False are not used. An empty folder, ``workspace``, keeps the pictures, the
    database and the model.
    """
    for picture in pictures:
        skew = float(picture.camera.K[0, 0, 1])
        if abs(skew) > 1e-9 * float(picture.camera.K[0, 0, 0]):
            raise ShapeError(
                f"picture {picture.name}: a camera with skew {skew:.6g}; expected 0, COLMAP's "
                "PINHOLE has none; resample the picture"
            )
    if workspace is not None:
        return _verify(pictures, workspace, seed)
    with tempfile.TemporaryDirectory(prefix="gvtools-") as folder:
        return _verify(pictures, Path(folder), seed)


def _verify(pictures: Sequence[PosedPicture], folder: Path, seed: int) -> GeometricVerification:
    limit = REPROJECTION_LIMIT * max((max(p.rgb.shape[:2]) for p in pictures), default=0)
    matched = _Matched([np.zeros((0, 2)) for _ in pictures], [])
    distances: list[Float64] = []
    model = None
    if len(pictures) > 1:
        with quiet_colmap():
            matched = _match(pictures, folder, seed)
            distances = _distances(pictures, matched)
            if any(map(len, distances)):
                model = _triangulate(pictures, folder, limit=limit, seed=seed)
    return _summary(pictures, matched, distances, model=model, limit=limit)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Matches between two pictures that a two-view geometry estimated from them agrees with."""

    i: int  # number of a picture
    j: int  # number of the other, above i
    rows: NDArray[np.uint32]  # (M, 2) uint32, the features' numbers in picture i and in picture j


@dataclass(frozen=True, eq=False)
class _Matched:
    """Features and matches of a set of pictures."""

    keypoints: list[Float64]  # per picture (N, 2) float64, places of its features, pixels
    pairs: list[_Pair]  # those with at least ``MIN_MATCHES`` verified matches, in order


def _match(pictures: Sequence[PosedPicture], folder: Path, seed: int) -> _Matched:
    """Extract features, where no mask is False, and match every pair; the poses play no part."""
    from gvtools.colmap import pycolmap

    names = write_pictures(((picture.rgb, picture.mask) for picture in pictures), folder)
    (folder / "model").mkdir()
    database = folder / "database.db"
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE", mask_path=folder / "masks")
    pycolmap.extract_features(
        database,
        folder / "images",
        image_names=names,
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1),
        device=pycolmap.Device.cpu,
    )
    set_intrinsics(database, np.concatenate([picture.camera.K for picture in pictures]))
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=MIN_MATCHES)
    verification.ransac.random_seed = seed
    pycolmap.set_random_seed(seed)
    pycolmap.match_exhaustive(
        database,
        matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=1),
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    keypoints = [np.zeros((0, 2)) for _ in pictures]
    pairs = []
    with pycolmap.Database.open(database) as opened:
        number = {image.image_id: row_of(image) for image in opened.read_all_images()}
        for image, row in number.items():
            keypoints[row] = opened.read_keypoints(image)[:, :2].astype(np.float64)
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            i, j = (number[image] for image in pycolmap.pair_id_to_image_pair(pair))
            rows = np.asarray(geometry.inlier_matches)
            if len(rows) >= MIN_MATCHES:
                pairs.append(_Pair(i, j, rows) if i < j else _Pair(j, i, rows[:, ::-1]))
    return _Matched(keypoints, sorted(pairs, key=lambda pair: (pair.i, pair.j)))


def _distances(pictures: Sequence[PosedPicture], matched: _Matched) -> list[Float64]:
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
        first, second = matched.keypoints[pair.i], matched.keypoints[pair.j]
        places = first[pair.rows[:, 0]], second[pair.rows[:, 1]]
        cameras = pictures[pair.i].camera, pictures[pair.j].camera
        distances.append(epipolar_distances(*cameras, places))
    return distances


def epipolar_distances(first: Cameras, second: Cameras, places: tuple[Float64, Float64]) -> Float64:
    """(M,) distances of matched places to each other's epipolar lines, the mean of both, pixels.

    The places are (M, 2) pixels of either picture, whose cameras have two centres. The lines are
    those of F = K₂⁻ᵀ [t]ₓ R K₁⁻¹ (Hartley and Zisserman, Multiple View Geometry, 2nd edition, eq.
    9.12).
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


def _triangulate(
    pictures: Sequence[PosedPicture], folder: Path, *, limit: float, seed: int
) -> pycolmap.Reconstruction:
    """Triangulate the verified matches; poses and intrinsics stay as they are."""
    from gvtools.colmap import pycolmap

    poses = np.concatenate([picture.camera.cam_from_world for picture in pictures])
    model = posed_model(folder / "database.db", poses)
    focal = min(float(picture.camera.K[0, 0, 0]) for picture in pictures)
    angle = float(np.degrees(np.arctan(limit / focal)))
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=seed, min_num_matches=MIN_MATCHES, extract_colors=False
    )
    options.mapper.filter_max_reproj_error = limit
    options.mapper.filter_min_tri_angle = MIN_TRIANGULATION_ANGLE
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.min_angle = MIN_TRIANGULATION_ANGLE
    options.triangulation.create_max_angle_error = angle
    options.triangulation.continue_max_angle_error = angle
    options.triangulation.merge_max_reproj_error = limit
    options.triangulation.complete_max_reproj_error = limit
    options.triangulation.random_seed = seed
    return pycolmap.triangulate_points(
        model, folder / "database.db", folder / "images", folder / "model", options=options
    )


def _summary(
    pictures: Sequence[PosedPicture],
    matched: _Matched,
    distances: Sequence[Float64],
    *,
    model: pycolmap.Reconstruction | None,
    limit: float,
) -> GeometricVerification:
    # Per picture, for each of its features the point that it observes, -1 for none.
    observed = [np.full(len(places), -1) for places in matched.keypoints]
    for image in model.images.values() if model else ():
        for row in image.get_observation_point2D_idxs():
            observed[row_of(image)][row] = image.points2D[row].point3D_id
    pairs = []
    for pair, distance in zip(matched.pairs, distances, strict=True):
        point = observed[pair.i][pair.rows[:, 0]]
        common = (point >= 0) & (point == observed[pair.j][pair.rows[:, 1]])
        first, second = pictures[pair.i].name, pictures[pair.j].name
        epipolar = median_of(distance)
        pairs.append(PairVerification(first, second, len(common), int(common.sum()), epipolar))
    verified = sum(pair.verified for pair in pairs)
    connected = {number for pair in matched.pairs for number in (pair.i, pair.j)}
    registered = [bool((points >= 0).any()) for points in observed]
    every = np.concatenate([np.zeros(0), *distances])
    points = model.num_points3D() if model else 0
    # A single picture has no figures.
    possible = len(pictures) * (len(pictures) - 1) // 2
    count = len(pictures) if possible else 0
    return GeometricVerification(
        status=_status(matched, verified, points=points, apart=bool(every.size)),
        images=len(pictures),
        pairs=tuple(pairs),
        mean_features=share(sum(map(len, matched.keypoints)), count),
        mean_verified=share(verified, possible),
        verified_share=share(len(connected), count),
        epipolar=median_of(every),
        epipolar_inlier_share=share(int((every <= EPIPOLAR_LIMIT).sum()), len(every)),
        triangulated_share=share(sum(pair.triangulated for pair in pairs), verified),
        registered_share=share(sum(registered), count),
        unregistered=tuple(
            picture.name for picture, seen in zip(pictures, registered, strict=True) if not seen
        ),
        points=points,
        mean_track_length=model.compute_mean_track_length() if model and points else None,
        mean_reprojection=model.compute_mean_reprojection_error() if model and points else None,
        reprojection_limit=limit,
    )


def _status(matched: _Matched, verified: int, *, points: int, apart: bool) -> str:
    count = len(matched.keypoints)
    if points:
        return "triangulated"
    if count < 2:
        return f"empty: {count} picture(s); at least 2 are needed"
    if not verified:
        features = sum(map(len, matched.keypoints))
        return (
            f"empty: no pair of the {count} pictures ({features} features) has {MIN_MATCHES} "
            "verified matches"
        )
    if not apart:
        return f"empty: {verified} verified matches, but none between cameras with two centres"
    return f"empty: none of the {verified} verified matches could be triangulated at the poses"
