"""Features of pictures, their matches and the verification of these, in COLMAP's database.

COLMAP's SIFT, or learned features that LightGlue matches (``learned_matching``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.capture import learned_matching
from gvtools.capture.pairs import sift_descriptors, similar_pairs

if TYPE_CHECKING:
    import pycolmap

    from gvtools.capture.panoramas import FaceRig
    from gvtools.features import FeatureMatcher

# Up to this many pictures, every pair is matched; fewer with LightGlue, which takes a second a pair
# on a processor.
EXHAUSTIVE, EXHAUSTIVE_LEARNED = 60, 30
# A frame of a video is matched with this many after it, and with those 16, 32, 64 and 128 later.
SEQUENTIAL_OVERLAP = 10
# Most features of a picture, and the longer side that it is reduced to before, pixels.
MAX_FEATURES, MAX_SIDE = 8192, 1600
SEED = 1
# Focal lengths that are tried, in lengths of the longer side, and how far homographies may be from
# rotations (Frobenius norm of R^T R - 1, the median of all pairs): 0.016 of a camera that turned,
# 0.10 of one that moved by a quarter of the distance before something almost flat. Seen by a long
# lens, a sideways walk is almost a rotation, too, but its miss is 1.4 of its motion (the norm of
# R - 1), where a rotation's is noise: expected below SHARE, for motions above STILL at a focal
# length of one side.
FOCALS, TURNED, SHARE, STILL = np.geomspace(0.4, 20, 40), 0.04, 0.5, 0.01

Say = Callable[[str], object]


def match_pictures(
    images: Path,
    cameras: Sequence[Sequence[str]],
    *,
    work: Path,
    in_order: bool,
    masks: Path | None,
    learned: FeatureMatcher | None,
    rigs: Sequence[FaceRig],
    fisheye: str,
    say: Say,
) -> tuple[Path, str]:
    """Fill a database with features and verified matches; see ``mapping.find_cameras``.

    Returns:
        The database, and in words how pairs were chosen.
    """
    import pycolmap

    database = work / "database.db"
    given = {
        rig.names(face)[0]: ("PINHOLE", face.target.params_to_string())
        for rig in rigs
        for face in rig.faces
    }
    if fisheye:
        given = {group[0]: ("OPENCV_FISHEYE", fisheye) for group in cameras}
    if learned is not None:
        pycolmap.Database.open(database).close()
    for group in cameras:
        reader = pycolmap.ImageReaderOptions()
        if group[0] in given:
            reader.camera_model, reader.camera_params = given[group[0]]
        if learned is None:
            extract(database, images, group, masks=masks, reader=reader)
        else:
            pycolmap.import_images(
                database, images, pycolmap.CameraMode.SINGLE, image_names=list(group),
                options=reader,
            )  # fmt: skip
    if rigs:
        with pycolmap.Database.open(database) as opened:
            pycolmap.apply_rig_config([rig.config() for rig in rigs], opened)
    if learned is None:
        count = sum(map(len, cameras))
        options = pycolmap.FeatureMatchingOptions()
        options.skip_image_pairs_in_same_frame = bool(rigs)
        how = _match(database, work, options=options, count=count, in_order=in_order, say=say)
        return database, how
    names = [name for group in cameras for name in group]
    features = learned_matching.extract(images, names, learned, masks=masks, say=say)
    learned_matching.write_keypoints(database, features)
    described = {name: found.descriptors for name, found in features.items()}
    chosen, how = _chosen(described, EXHAUSTIVE_LEARNED, in_order=in_order)
    if rigs:
        with pycolmap.Database.open(database) as opened:
            frame = {image.name: image.frame_id for image in opened.read_all_images()}
        chosen = [(a, b) for a, b in chosen if frame[a] != frame[b]]
    say(f"matching {len(chosen)} pairs")
    learned_matching.write_matches(database, features, chosen, matcher=learned, say=say)
    pycolmap.verify_matches(database, listed(chosen, work), verification())
    return database, how


def extract(
    database: Path,
    images: Path,
    names: Sequence[str],
    *,
    masks: Path | None,
    reader: pycolmap.ImageReaderOptions,
    side: int = MAX_SIDE,
    features: int = MAX_FEATURES,
    first_octave: int = -1,
    one_camera: bool = True,
) -> None:
    """Find SIFT features of some pictures.

    Args:
        database: where they go.
        images: folder of the pictures.
        names: in it.
        masks: folder of masks, black where no feature may be.
        reader: COLMAP's options of cameras.
        side: longer side that pictures are reduced to before, pixels.
        features: at most so many of a picture.
        first_octave: -1 doubles pictures before; 0 takes a quarter of the time.
        one_camera: whether all of them have one camera, and so one size.
    """
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = side
    options.sift.max_num_features = features
    options.sift.first_octave = first_octave
    if masks is not None:
        reader.mask_path = masks
    mode = pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database, images, image_names=list(names), camera_mode=mode,
        reader_options=reader, extraction_options=options, device=pycolmap.Device.auto,
    )  # fmt: skip


def _match(
    database: Path,
    work: Path,
    *,
    options: pycolmap.FeatureMatchingOptions,
    count: int,
    in_order: bool,
    say: Say,
) -> str:
    """Match SIFT of pairs of pictures; returns in words how the pairs were chosen."""
    import pycolmap

    if count <= EXHAUSTIVE:
        say(f"matching all {count * (count - 1) // 2} pairs")
        pycolmap.match_exhaustive(
            database, matching_options=options, verification_options=verification()
        )
        return "all pairs"
    pairs, how = _chosen(sift_descriptors(database), EXHAUSTIVE, in_order=in_order)
    say(f"matching {len(pairs)} pairs")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed(pairs, work)
    pycolmap.match_image_pairs(
        database, matching_options=options, pairing_options=pairing,
        verification_options=verification(),
    )  # fmt: skip
    return how


def _chosen(
    described: Mapping[str, NDArray[np.float32]], exhaustive: int, *, in_order: bool
) -> tuple[list[tuple[str, str]], str]:
    """The pairs of pictures to match, and in words how they were chosen.

    Args:
        described: (N, D) descriptors of each picture by name.
        exhaustive: up to how many pictures every pair is taken.
        in_order: see ``mapping.find_cameras``.
    """
    names = sorted(described)
    if len(names) <= exhaustive:
        return list(combinations(names, 2)), "all pairs"
    pairs = set(similar_pairs(described))
    how = f"each picture with the {len(pairs) * 2 // len(names)} most similar"
    if in_order:
        steps = {*range(1, SEQUENTIAL_OVERLAP + 1), *(2**k for k in range(4, 8))}
        pairs |= {
            (names[i], names[i + step])
            for i in range(len(names))
            for step in steps
            if i + step < len(names)
        }
        how = f"neighbours in time, and {how}"
    return sorted(pairs), how


def listed(pairs: Sequence[tuple[str, str]], work: Path) -> Path:
    """A file with the pairs, as COLMAP reads them."""
    file = work / "pairs.txt"
    file.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    return file


def verification() -> pycolmap.TwoViewGeometryOptions:
    """COLMAP's options of verifying matches, the same every time."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return options


def verified(database: Path) -> dict[tuple[str, str], int]:
    """Pairs of pictures that overlap, with the number of their verified matches."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        numbers, counts = opened.read_two_view_geometry_num_inliers()
    found = {}
    for number, count in zip(numbers, counts, strict=True):
        if count > 0:
            a, b = pycolmap.pair_id_to_image_pair(number)
            found[names[a], names[b]] = int(count)
    return found


def flat_pairs(database: Path) -> list[tuple[NDArray[np.float64], tuple[int, int]]]:
    """Homographies, and sizes of the pictures, where one explains every pair; else empty.

    Two-view geometry then has no depth to go by: the scene is flat, or the camera only turned.
    """
    import pycolmap

    kinds = pycolmap.TwoViewGeometryConfiguration
    flat = (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
    with pycolmap.Database.open(database) as opened:
        numbers, geometries = opened.read_two_view_geometries()
        sizes = {}
        for image in opened.read_all_images():
            camera = opened.read_camera(image.camera_id)
            sizes[image.image_id] = (camera.width, camera.height)
    found = []
    for number, geometry in zip(numbers, geometries, strict=True):
        if not len(geometry.inlier_matches):
            continue
        if geometry.config not in flat or geometry.H is None:
            return []
        found.append((geometry.H, sizes[pycolmap.pair_id_to_image_pair(number)[0]]))
    return found


def only_turned(pairs: Sequence[tuple[NDArray[np.float64], tuple[int, int]]]) -> bool:
    """Whether homographies are those of a camera that turns on the spot, at some focal length.

    Such a homography is K R K^-1 (R. Hartley and A. Zisserman, Multiple View Geometry, 8.4).

    Args:
        pairs: pixels to pixels, and the size of the pictures.

    >>> turned_by_2 = np.array([[0.999391, 0, 20.94], [0, 1, 0], [-5.8166e-5, 0, 0.999391]])
    >>> K = np.array([[1.0, 0, 320], [0, 1, 240], [0, 0, 1]])
    >>> only_turned([(K @ turned_by_2 @ np.linalg.inv(K), (640, 480))])
    True
    >>> only_turned([(np.array([[1.0, 0, 32], [0, 1, 0], [0, 0, 1]]), (640, 480))])  # sideways
    False
    """
    found = []
    for H, (width, height) in pairs:
        centred = np.array([[1.0, 0, width / 2], [0, 1, height / 2], [0, 0, 1]])
        moved = np.linalg.inv(centred) @ H @ centred
        scale = np.cbrt(np.linalg.det(moved))
        if scale:
            side = max(width, height)
            still = _from_rotation(moved / scale, side)[1] < STILL
            tried = [_from_rotation(moved / scale, focal * side) for focal in FOCALS]
            found.append([(miss, 0.0 if still else miss / motion) for miss, motion in tried])
    if not found:
        return False
    misses, shares = np.median(found, axis=0).T
    return bool(((misses < TURNED) & (shares < SHARE)).any())


def _from_rotation(H: NDArray[np.float64], focal: float) -> tuple[float, float]:
    """How far a homography is from a rotation, and how far from the identity (Frobenius norms)."""
    K = np.diag([focal, focal, 1.0])
    turn = np.linalg.inv(K) @ H @ K
    miss = float(np.linalg.norm(turn.T @ turn - np.eye(3)))
    return miss, max(float(np.linalg.norm(turn - np.eye(3))), 1e-9)
