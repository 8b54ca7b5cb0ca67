"""COLMAP run on pictures whose poses are given: features, verified matches, triangulation.

One thread on the CPU with fixed seeds: equal pictures give equal results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gvtools.cameras import Float64
from gvtools.evaluation.posed_picture import PosedPicture

if TYPE_CHECKING:
    import pycolmap

# COLMAP's default: fewer inliers do not make a pair.
MIN_MATCHES = 15
# Degrees between rays. COLMAP's 1.5 would leave out near pairs, whose matches still tell.
MIN_TRIANGULATION_ANGLE = 0.2


@dataclass(frozen=True, eq=False)
class VerifiedMatches:
    """Matches between two pictures that a two-view geometry estimated from them agrees with.

    Attributes:
        i: number of a picture.
        j: number of the other, above i.
        rows: (M, 2) uint32, the features' numbers in picture i and in picture j.
    """

    i: int
    j: int
    rows: NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class Matched:
    """Features and matches of a set of pictures.

    Attributes:
        keypoints: per picture (N, 2) float64, places of its features, pixels.
        pairs: those with at least ``MIN_MATCHES`` verified matches, in order.
    """

    keypoints: tuple[Float64, ...]
    pairs: tuple[VerifiedMatches, ...] = ()


def match_pictures(pictures: Sequence[PosedPicture], folder: Path, *, seed: int) -> Matched:
    """Extract features and match every pair; the poses play no part.

    Args:
        pictures: the views; features where a mask is False are left out.
        folder: empty; receives the pictures, masks and ``database.db``.
        seed: of the random sampling.
    """
    import pycolmap

    masked = any(picture.mask is not None for picture in pictures)
    _write_pictures(pictures, folder, with_masks=masked)
    database = folder / "database.db"
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE")
    if masked:
        reader.mask_path = folder / "masks"
    pycolmap.extract_features(
        database,
        folder / "images",
        image_names=[_file(number) for number in range(len(pictures))],
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1),
        device=pycolmap.Device.cpu,
    )
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            K = pictures[_number(image)].camera.K[0]
            camera = opened.read_camera(image.camera_id)
            camera.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            camera.has_prior_focal_length = True
            opened.update_camera(camera)
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=MIN_MATCHES)
    verification.ransac.random_seed = seed
    pycolmap.set_random_seed(seed)
    pycolmap.match_exhaustive(
        database,
        matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=1),
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    return _read_matches(database, len(pictures))


def triangulate(
    pictures: Sequence[PosedPicture], matched: Matched, folder: Path, *, limit: float, seed: int
) -> pycolmap.Reconstruction:
    """Triangulate the verified matches; poses and intrinsics stay as they are.

    Args:
        pictures: those that were matched.
        matched: what `match_pictures` made of them, with at least one pair.
        folder: where it did so; receives the model.
        limit: largest reprojection error of an observation, pixels.
        seed: of the random sampling.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(folder / "database.db") as opened:
        for image in opened.read_all_images():
            number = _number(image)
            model.add_camera_with_trivial_rig(opened.read_camera(image.camera_id))
            posed = pycolmap.Image(
                name=image.name,
                keypoints=matched.keypoints[number],
                camera_id=image.camera_id,
                image_id=image.image_id,
            )
            pose = pictures[number].camera.cam_from_world[0, :3]
            model.add_image_with_trivial_frame(posed, pycolmap.Rigid3d(pose))
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


def observed_points(
    model: pycolmap.Reconstruction | None, matched: Matched
) -> list[NDArray[np.int64]]:
    """Per picture, for each of its features the point that it observes, -1 for none."""
    observed = [np.full(len(places), -1) for places in matched.keypoints]
    for image in model.images.values() if model else ():
        for row in image.get_observation_point2D_idxs():
            observed[_number(image)][row] = image.points2D[row].point3D_id
    return observed


def _file(number: int) -> str:
    return f"{number:06d}.png"


def _number(image: pycolmap.Image) -> int:
    return int(Path(image.name).stem)


def _write_pictures(pictures: Sequence[PosedPicture], folder: Path, *, with_masks: bool) -> None:
    for name in ("images", "masks", "model"):
        (folder / name).mkdir()
    for number, picture in enumerate(pictures):
        Image.fromarray(picture.rgb).save(folder / "images" / _file(number), compress_level=1)
        if with_masks:  # COLMAP then wants one for every picture
            mask = np.ones(picture.rgb.shape[:2], bool) if picture.mask is None else picture.mask
            bright = Image.fromarray(mask.astype(np.uint8) * 255)
            bright.save(folder / "masks" / f"{_file(number)}.png")


def _read_matches(database: Path, count: int) -> Matched:
    import pycolmap

    keypoints = [np.zeros((0, 2)) for _ in range(count)]
    pairs = []
    with pycolmap.Database.open(database) as opened:
        number = {image.image_id: _number(image) for image in opened.read_all_images()}
        for image, row in number.items():
            keypoints[row] = opened.read_keypoints(image)[:, :2].astype(np.float64)
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            i, j = (number[image] for image in pycolmap.pair_id_to_image_pair(pair))
            rows = np.asarray(geometry.inlier_matches)
            if len(rows) >= MIN_MATCHES:
                pairs.append(
                    VerifiedMatches(i, j, rows) if i < j else VerifiedMatches(j, i, rows[:, ::-1])
                )
    return Matched(tuple(keypoints), tuple(sorted(pairs, key=lambda pair: (pair.i, pair.j))))
