"""Cameras from photographs: features, matching and mapping by pycolmap.

Features are COLMAP's SIFT, or learned ones that LightGlue matches; where matching all pictures with
all would take too long, pairs that look alike are.

Global mapping (GLOMAP, Pan et al. 2024) solves for all cameras at once. It can end in a model whose
parts have different scales, with every picture registered and small reprojection errors (the fox of
instant-ngp: camera centres wrong by 35 % of their extent, reprojection errors of 0.5 pixels). The
share of verified matches that became 3D points reveals such a model: 69 % there, 94 % in the right
one. If that share is low, incremental mapping is tried as well, and the model with the larger share
is kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gvtools.cameras import reduced_size
from gvtools.capture.panoramas import FaceRig
from gvtools.colmap import pycolmap
from gvtools.errors import ProjectError
from gvtools.features import FeatureMatcher, Features, quiet_colmap, root_sift
from gvtools.poses.colmap import SEED, adjust, extract_sift, fix_cameras, list_pairs, verification
from gvtools.scenes.images import check_size, read_image, read_mask

# Up to this many pictures, every pair is matched; fewer with LightGlue, which takes a second a pair
# on a processor.
EXHAUSTIVE, EXHAUSTIVE_LEARNED = 60, 30
# A frame of a video is matched with this many after it, and with those 16, 32, 64 and 128 later.
SEQUENTIAL_OVERLAP = 10
# Learned features: the longer side that pictures are reduced to, pixels, that of the pictures
# LightGlue's authors test with, and keypoints of a picture, of the highest score.
LEARNED_SIDE, LEARNED_FEATURES = 1024, 1024
# Lines about progress come after so many pictures or pairs.
EVERY = 100
# Partners that each picture gets where not all are matched with all; centres of the descriptor by
# which they are found, features of a picture that it is made of, and rounds of k-means.
NEAREST, WORDS, FEATURES, ROUNDS = 20, 32, 1000, 8
# Focal lengths that are tried, in lengths of the longer side, and how far homographies may be from
# rotations (Frobenius norm of R^T R - 1, the median of all pairs): 0.016 of a camera that turned,
# 0.10 of one that moved by a quarter of the distance before something almost flat. Seen by a long
# lens, a sideways walk is almost a rotation, too, but its miss is 1.4 of its motion (the norm of
# R - 1), where a rotation's is noise: expected below SHARE, for motions above STILL at a focal
# length of one side.
FOCALS, TURNED, SHARE, STILL = np.geomspace(0.4, 20, 40), 0.04, 0.5, 0.01
# If a smaller share of the verified matches became points of the global model, incremental mapping
# is tried, too.
ENOUGH = 0.9
# A picture that sees fewer 3D points is deregistered: global mapping keeps some that see a dozen,
# and these distort the whole model (demo room: camera centres wrong by 28 % of their extent, by 2 %
# without them).
LEAST_POINTS = 30
# Principal points are refined if every camera took at least this many pictures; fewer do not
# determine them.
REFINED_FROM = 8
# Observations with a larger reprojection error are dropped [px]: COLMAP's projection of fisheye
# models is not finite near 90 degrees off the axis.
LOST = 64.0
# Where each pair is explained by a plane, models whose rays meet at less are made up [degrees]: 3
# of a camera that only turned, 10 of a walk past something almost flat.
STEEP = 5.0

Say = Callable[[str], object]
Pairs = Mapping[tuple[str, str], int]  # number of verified matches of pairs of pictures, by names


@dataclass(frozen=True, eq=False)
class MappingTask:
    """Pictures whose cameras are to be found, and how."""

    images: Path
    # Names of the pictures that each camera took; they share its intrinsics.
    cameras: Sequence[Sequence[str]]
    work: Path  # a folder without files yet, for COLMAP's database and models
    source: Path | None = None  # the user's folder for messages, if ``images`` holds copies
    # The pictures follow a path in the order of their names, as frames of a video do; neighbours
    # are then matched even if there are too many pictures to match all pairs.
    in_order: bool = False
    # Folder of masks as COLMAP has them, ``a.jpg.png`` for ``a.jpg``, black where no features are.
    masks: Path | None = None
    learned: FeatureMatcher | None = None  # finds and matches features; None takes COLMAP's SIFT
    # Faces of panoramas, whose names ``cameras`` holds face by face; their intrinsics and relative
    # rotations are fixed.
    rigs: Sequence[FaceRig] = ()
    # Initial parameters of OPENCV_FISHEYE as COLMAP writes them; "" for other lenses.
    fisheye: str = ""
    say: Say = lambda text: None

    @property
    def names(self) -> list[str]:
        """Of all pictures."""
        return [name for group in self.cameras for name in group]


@dataclass(frozen=True, eq=False)
class MappingResult:
    """What mapping found."""

    # The one with the most registered pictures; its scale is arbitrary.
    model: pycolmap.Reconstruction
    how: str  # "global" or "incremental" mapping
    # Names of the pictures of each further model, the largest model first.
    others: tuple[tuple[str, ...], ...]
    matching: str  # how pairs were chosen, in words
    pairs: Pairs
    explained: float  # share of the matches of pairs in one model that became points, 0 to 1
    flat: bool = False  # every pair is explained by a plane, so that intrinsics hang by little


def find_cameras(task: MappingTask) -> MappingResult:
    """Find intrinsics and poses of pictures."""
    source, count = task.source or task.images, len(task.names)
    with quiet_colmap(errors=False):
        pycolmap.set_random_seed(SEED)
        task.say(f"finding features in {count} pictures")
        database, matching = match_pictures(task)
        pairs = verified(database)
        if not pairs:
            raise ProjectError(
                f"{source}: no two of the {count} pictures show enough of the same; expected "
                "neighbours that share at least half of what they show; take more pictures between "
                "these, and sharp ones"
            )
        flat = flat_pairs(database)
        if only_turned(flat):
            raise _no_depth(source, len(pairs))
        task.say(f"finding cameras from {len(pairs)} pairs that overlap")
        found = _map(database, task, pairs)
    if not found:
        best = max(pairs, key=lambda pair: pairs[pair])
        raise ProjectError(
            f"{source}: {len(pairs)} pairs of pictures overlap (best {best[0]} and {best[1]}, "
            f"{pairs[best]} matches), and no model comes of them; expected views from different "
            "places; take pictures while walking, not while turning on the spot"
        )
    how, models, share = found
    largest, *rest = sorted(models, key=lambda model: -model.num_reg_images())
    if flat and _angle(largest) < STEEP:
        raise _no_depth(source, len(pairs))
    others = tuple(tuple(sorted(_names(model))) for model in rest)
    return MappingResult(largest, how, others, matching, pairs, share, flat=bool(flat))


def _names(model: pycolmap.Reconstruction) -> set[str]:
    """The pictures that have a camera."""
    return {image.name for image in model.images.values() if image.has_pose}


def _no_depth(source: Path, pairs: int) -> ProjectError:
    return ProjectError(
        f"{source}: {pairs} pairs of pictures overlap, and each shows the other's plane alone: the "
        "camera only turned or zoomed, or the scene is flat; expected views from different places "
        "of something with depth; take pictures while walking"
    )


def _angle(model: pycolmap.Reconstruction) -> float:
    """Degrees between the outermost rays to a point, the median of all points."""
    centers = {key: image.projection_center() for key, image in model.images.items()
               if image.has_pose}  # fmt: skip
    angles = []
    for point in model.points3D.values():
        rays = np.array([centers[seen.image_id] for seen in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return float(np.median(angles)) if angles else 0.0


def _map(
    database: Path, task: MappingTask, pairs: Pairs
) -> tuple[str, list[pycolmap.Reconstruction], float] | None:
    """The better of "global" and "incremental" mapping, its models, and what they explain.

    Intrinsics of faces, and their rotations, are fixed. None where neither gives a model.
    """
    globally, pipeline = pycolmap.GlobalPipelineOptions(), pycolmap.IncrementalPipelineOptions()
    globally.random_seed = pipeline.random_seed = SEED
    # COLMAP's default drops models of fewer than 10 pictures.
    pipeline.min_model_size = 2
    if task.rigs:
        globally.mapper.refine_sensor_from_rig = False
        fix_cameras(globally.mapper.bundle_adjustment)
        pipeline.ba_refine_focal_length = False
        pipeline.ba_refine_extra_params = False
        pipeline.ba_refine_sensor_from_rig = False
    best = None
    ways: tuple[tuple[str, Any, Any], ...] = (
        ("global", pycolmap.global_mapping, globally),
        ("incremental", pycolmap.incremental_mapping, pipeline),
    )
    for how, mapping, options in ways:
        out = task.work / how
        out.mkdir()
        try:
            models = list(mapping(database, task.images, out, options=options).values())
        except (RuntimeError, ValueError):
            models = []
        for model in models:
            _settle(model, refine=not task.rigs)
        models = [model for model in models if model.num_reg_images() >= 2]
        if models:
            share = _explained(models, pairs)
            if best is None or share > best[2]:
                best = how, models, share
        if models and share >= ENOUGH:
            break
        if how == "global":
            told = f"explains {share:.0%} of the matches" if models else "gives no model"
            task.say(f"global mapping {told}; trying incremental mapping")
    return best


def _explained(models: Sequence[pycolmap.Reconstruction], pairs: Pairs) -> float:
    """Share of the verified matches that became points of the largest model.

    Pairs of which another model has both pictures are of another place, and are no fault of it.
    """
    largest, *rest = sorted(models, key=lambda model: -model.num_reg_images())
    elsewhere = [_names(model) for model in rest]
    shared = shared_points(largest)
    became = matches = 0
    for pair, count in pairs.items():
        if not any(others.issuperset(pair) for others in elsewhere):
            matches += count
            became += min(count, shared[min(pair), max(pair)])
    return became / max(1, matches)


def shared_points(model: pycolmap.Reconstruction) -> Counter[tuple[str, str]]:
    """Pairs of pictures, each in order of names, and how many points both see."""
    names = {image.image_id: image.name for image in model.images.values()}
    shared: Counter[tuple[str, str]] = Counter()
    for point in model.points3D.values():
        seen = sorted({names[element.image_id] for element in point.track.elements})
        shared.update(combinations(seen, 2))
    return shared


def _settle(model: pycolmap.Reconstruction, *, refine: bool) -> None:
    """Deregister pictures that see too few points, then bundle-adjust the rest once more."""
    # Counted by frame (COLMAP's word for one shot of a rig): a panorama's faces stay together.
    seen: Counter[int] = Counter()
    for image in model.images.values():
        if image.has_pose:
            seen[image.frame_id] += image.num_points3D
    for frame, count in seen.items():
        if count < LEAST_POINTS:
            model.deregister_frame(frame)
    if model.num_reg_images() < 2:
        return
    options = pycolmap.BundleAdjustmentOptions()
    if not refine:
        fix_cameras(options)
    adjust(model, options)
    images = [image for image in model.images.values() if image.has_pose]
    counts = [sum(image.camera_id == camera for image in images) for camera in model.cameras]
    if refine and min(counts) >= REFINED_FROM:
        options.refine_principal_point = True
        adjust(model, options)
    pycolmap.ObservationManager(model).filter_all_points3D(LOST, 0.0)
    model.update_point_3d_errors()


def match_pictures(task: MappingTask) -> tuple[Path, str]:
    """Fill a database with features and verified matches; returns it, and how pairs were chosen."""
    database, learned, rigs = task.work / "database.db", task.learned, task.rigs
    given = {
        rig.names(face)[0]: ("PINHOLE", face.target.params_to_string())
        for rig in rigs
        for face in rig.faces
    }
    if task.fisheye:
        given = {group[0]: ("OPENCV_FISHEYE", task.fisheye) for group in task.cameras}
    if learned is not None:
        pycolmap.Database.open(database).close()
    for group in task.cameras:
        reader = pycolmap.ImageReaderOptions()
        if group[0] in given:
            reader.camera_model, reader.camera_params = given[group[0]]
        if learned is None:
            extract_sift(database, task.images, group, masks=task.masks, reader=reader)
        else:
            pycolmap.import_images(
                database, task.images, pycolmap.CameraMode.SINGLE, image_names=list(group),
                options=reader,
            )  # fmt: skip
    if rigs:
        with pycolmap.Database.open(database) as opened:
            pycolmap.apply_rig_config([rig.config() for rig in rigs], opened)
    if learned is None:
        return database, _match_sift(database, task)
    features = learned_features(task.images, task.names, learned, masks=task.masks, say=task.say)
    write_keypoints(database, features)
    described = {name: found.descriptors for name, found in features.items()}
    chosen, how = _choose_pairs(described, EXHAUSTIVE_LEARNED, in_order=task.in_order)
    with pycolmap.Database.open(database) as opened:
        stored = {image.name: image for image in opened.read_all_images()}
        if rigs:
            chosen = [(a, b) for a, b in chosen if stored[a].frame_id != stored[b].frame_id]
        task.say(f"matching {len(chosen)} pairs")
        for number, (first, second) in enumerate(chosen, start=1):
            rows = learned.match(features[first], features[second]).astype(np.uint32)
            opened.write_matches(stored[first].image_id, stored[second].image_id, rows)
            if number % EVERY == 0:
                task.say(f"{number} of {len(chosen)} pairs matched")
    pycolmap.verify_matches(database, list_pairs(chosen, task.work), verification())
    return database, how


def _match_sift(database: Path, task: MappingTask) -> str:
    """Match SIFT of pairs of pictures; returns in words how the pairs were chosen."""
    options, count = pycolmap.FeatureMatchingOptions(), len(task.names)
    options.skip_image_pairs_in_same_frame = bool(task.rigs)
    if count <= EXHAUSTIVE:
        task.say(f"matching all {count * (count - 1) // 2} pairs")
        pycolmap.match_exhaustive(
            database, matching_options=options, verification_options=verification()
        )
        return "all pairs"
    pairs, how = _choose_pairs(sift_descriptors(database), EXHAUSTIVE, in_order=task.in_order)
    task.say(f"matching {len(pairs)} pairs")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = list_pairs(pairs, task.work)
    pycolmap.match_image_pairs(
        database, matching_options=options, pairing_options=pairing,
        verification_options=verification(),
    )  # fmt: skip
    return how


def _choose_pairs(
    described: Mapping[str, NDArray[np.float32]], exhaustive: int, *, in_order: bool
) -> tuple[list[tuple[str, str]], str]:
    """The pairs of pictures to match, all of them up to ``exhaustive`` pictures, and why these."""
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


def similar_pairs(
    described: Mapping[str, NDArray[np.float32]], *, nearest: int = NEAREST
) -> list[tuple[str, str]]:
    """Pairs of pictures whose features are alike, by a descriptor learnt from these pictures.

    Each picture is described by VLAD (Jegou et al. 2010): the sum of its features' differences from
    the nearest of WORDS centres, which k-means finds among all of them. Each gets ``nearest``
    partners, and may be chosen by more; ``described`` holds (N, D) unit descriptors by name.
    """
    # In the order of names, so that pairs are chosen alike every time.
    names = sorted(name for name, rows in described.items() if len(rows))
    if len(names) < 2:
        return []
    features = [
        rows[np.linspace(0, len(rows) - 1, min(FEATURES, len(rows))).astype(int)]
        for rows in (described[name] for name in names)
    ]
    rng = np.random.default_rng(0)
    sample = np.concatenate([rows[rng.permutation(len(rows))[:200]] for rows in features])
    stop = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0.0)
    cv2.setRNGSeed(0)
    words = min(WORDS, len(sample))
    labels = np.zeros((len(sample), 1), np.int32)
    _, _, centres = cv2.kmeans(sample, words, labels, stop, 1, cv2.KMEANS_PP_CENTERS)
    images = np.stack([_vlad(rows, np.asarray(centres, np.float32)) for rows in features])
    alike = images @ images.T
    np.fill_diagonal(alike, -np.inf)
    pairs = set()
    for row, values in enumerate(alike):
        for column in np.argsort(-values)[: min(nearest, len(names) - 1)]:
            pairs.add((min(row, int(column)), max(row, int(column))))
    return sorted((names[a], names[b]) for a, b in pairs)


def sift_descriptors(database: Path) -> dict[str, NDArray[np.float32]]:
    """(N, 128) RootSIFT descriptors of each picture in COLMAP's database."""
    described = {}
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            rows = np.asarray(opened.read_descriptors(image.image_id).data, np.float32)
            rows = rows.reshape(-1, 128)
            rows = rows[np.linspace(0, len(rows) - 1, min(FEATURES, len(rows))).astype(int)]
            described[image.name] = root_sift(rows)
    return described


def _vlad(features: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.float32]:
    """(W * D,) unit descriptor of (N, D) features by (W, D) centres."""
    nearest = np.argmin((centres**2).sum(1) - 2 * features @ centres.T, axis=1)
    sums = np.zeros_like(centres)
    np.add.at(sums, nearest, features - centres[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    flat = sums.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-9)


def learned_features(
    images: Path,
    names: Sequence[str],
    matcher: FeatureMatcher,
    *,
    masks: Path | None = None,
    say: Say = lambda text: None,
) -> dict[str, Features]:
    """Features of pictures, in the pixels of the pictures as they are stored."""
    found = {}
    for number, name in enumerate(names, start=1):
        rgb = read_image(images / name).rgb
        height, width = rgb.shape[:2]
        small = reduced_size(width, height, LEARNED_SIDE)
        if small != (width, height):
            rgb = np.asarray(Image.fromarray(rgb).resize(small, Image.Resampling.LANCZOS))
        features = matcher.extract(np.ascontiguousarray(rgb))
        # Pixels' centres are at +0.5 in both pictures, so that positions scale; a learned one may
        # lie half a pixel outside.
        xy = features.xy * (np.array([width, height]) / small)
        xy = np.clip(xy, 0.5, [width - 0.5, height - 0.5])
        features = Features(xy, features.descriptors, width, height)
        mask = None if masks is None else masks / f"{name}.png"
        if mask is not None and mask.is_file():
            usable = read_mask(mask)
            check_size(usable.shape[::-1], (width, height), path=mask)
            x, y = np.floor(xy).astype(int).T
            features = features[usable[y, x]]
        found[name] = features
        if number % EVERY == 0:
            say(f"features of {number} of {len(names)} pictures")
    return found


def write_keypoints(database: Path, features: Mapping[str, Features]) -> None:
    """Write keypoints of all of the database's pictures, by their names."""
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            opened.write_keypoints(image.image_id, features[image.name].xy.astype(np.float32))


def verified(database: Path) -> dict[tuple[str, str], int]:
    """Pairs of pictures that overlap, with the number of their verified matches."""
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

    Such a homography is K R K^-1 (R. Hartley and A. Zisserman, Multiple View Geometry, 8.4). Each
    takes pixels to pixels, and comes with the size of the pictures.

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
