"""Cameras from photographs: features, matching and mapping by pycolmap.

Global mapping (GLOMAP, Pan et al. 2024) solves for all cameras at once. It can end in a model whose
parts have different scales, with every picture registered and small reprojection errors (a scene of
a stuffed fox: camera centres wrong by 35 % of their extent, errors of 0.5 pixels). Such a model is
told by the share of verified matches that became 3D points: 69 % there, 94 % in the right one.
Where that share is low, incremental mapping is tried as well, and the model with the larger share
is kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.capture import learned_matching
from gvtools.capture.pairs import sift_descriptors, similar_pairs
from gvtools.errors import ProjectError

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pycolmap

    from gvtools.evaluation.pose_probe.features import FeatureMatcher

# Up to this many pictures, every pair is matched; fewer with LightGlue, which takes a second a pair
# on a processor.
EXHAUSTIVE, EXHAUSTIVE_LEARNED = 60, 30
# A frame of a video is matched with this many after it, and with those 16, 32, 64 and 128 later.
SEQUENTIAL_OVERLAP = 10
# Most features of a picture, and the longer side that it is reduced to before, pixels.
MAX_FEATURES, MAX_SIDE = 8192, 1600
# Where a smaller share of the verified matches became points of the global model, it is compared
# with an incremental one.
ENOUGH = 0.9
# A picture that sees fewer 3D points is deregistered: global mapping keeps some that see a dozen,
# and these distort the whole model (demo room: camera centres wrong by 28 % of their extent, by 2 %
# without them).
LEAST_POINTS = 30
# Principal points are refined where every camera took at least this many pictures; fewer do not
# determine them.
REFINED_FROM = 8
SEED = 1

Say = Callable[[str], object]


@dataclass(frozen=True, eq=False)
class Mapped:
    """What mapping found.

    Attributes:
        model: the one with the most registered pictures; its scale is arbitrary.
        how: "global" or "incremental" mapping.
        others: the pictures that each further model registered, most first.
        matching: how pairs were chosen, in words.
        pairs: number of verified matches of each pair of pictures, by their names.
        explained: share of these matches that became points of the model, 0 to 1.
    """

    model: pycolmap.Reconstruction
    how: str
    others: tuple[tuple[str, ...], ...]
    matching: str
    pairs: Mapping[tuple[str, str], int]
    explained: float


def find_cameras(
    images: Path,
    cameras: Sequence[Sequence[str]],
    *,
    work: Path,
    source: Path | None = None,
    in_order: bool = False,
    masks: Path | None = None,
    learned: FeatureMatcher | None = None,
    say: Say = lambda text: None,
) -> Mapped:
    """Find intrinsics and poses of pictures.

    Args:
        images: the folder of the pictures.
        cameras: names of the pictures that each camera took; they share its intrinsics.
        work: a folder without files yet, for COLMAP's database and models.
        source: what messages name, where ``images`` are copies.
        in_order: the pictures follow a path in the order of their names, as frames of a video do;
            then neighbours are matched, too, where there are too many pictures to match all pairs.
        masks: folder of masks as COLMAP has them, ``a.jpg.png`` for ``a.jpg``, black where no
            features are to be found; None for none.
        learned: finds and matches features; None takes COLMAP's SIFT.
        say: is called with a line of text at each step.

    Raises:
        ProjectError: no two pictures overlap, or no model comes of those that do.
    """
    import pycolmap

    with _quiet():
        pycolmap.set_random_seed(SEED)
        database = work / "database.db"
        names = [name for group in cameras for name in group]
        say(f"finding features in {len(names)} pictures")
        if learned is None:
            for group in cameras:
                _extract(database, images, group, masks=masks)
            matching = _match(database, work, count=len(names), in_order=in_order, say=say)
        else:
            pycolmap.Database.open(database).close()
            for group in cameras:
                pycolmap.import_images(
                    database, images, pycolmap.CameraMode.SINGLE, image_names=list(group)
                )
            features = learned_matching.extract(images, names, learned, masks=masks, say=say)
            learned_matching.write_keypoints(database, features)
            described = {name: found.descriptors for name, found in features.items()}
            chosen, matching = _chosen(described, EXHAUSTIVE_LEARNED, in_order=in_order)
            say(f"matching {len(chosen)} pairs")
            learned_matching.write_matches(database, features, chosen, matcher=learned, say=say)
            pycolmap.verify_matches(database, _listed(chosen, work), _verification())
        pairs = _verified(database)
        if not pairs:
            raise ProjectError(
                f"{source or images}: no two of the {len(names)} pictures show enough of the same; "
                "expected neighbours that share at least half of what they show; take more "
                "pictures between these, and sharp ones"
            )
        if _all_flat(database):
            raise ProjectError(
                f"{source or images}: {len(pairs)} pairs of pictures overlap, and each shows the "
                "other's plane alone: the camera only turned or zoomed, or the scene is flat; "
                "expected views from different places of something with depth; take pictures "
                "while walking"
            )
        say(f"finding cameras from {len(pairs)} pairs that overlap")
        found = _map(database, images, work, pairs=pairs, say=say)
    if not found:
        best = max(pairs, key=lambda pair: pairs[pair])
        raise ProjectError(
            f"{source or images}: {len(pairs)} pairs of pictures overlap (best {best[0]} and "
            f"{best[1]}, {pairs[best]} matches), and no model comes of them; expected views "
            "from different places; take pictures while walking, not while turning on the spot"
        )
    how, models, share = found
    largest, *rest = sorted(models, key=lambda model: -model.num_reg_images())
    others = tuple(
        tuple(sorted(image.name for image in model.images.values() if image.has_pose))
        for model in rest
    )
    return Mapped(largest, how, others, matching, pairs=pairs, explained=share)


def _extract(database: Path, images: Path, names: Sequence[str], *, masks: Path | None) -> None:
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = MAX_SIDE
    options.sift.max_num_features = MAX_FEATURES
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    pycolmap.extract_features(
        database, images, image_names=list(names), camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader, extraction_options=options, device=pycolmap.Device.auto,
    )  # fmt: skip


def _match(database: Path, work: Path, *, count: int, in_order: bool, say: Say) -> str:
    """Match SIFT of pairs of pictures; returns in words how the pairs were chosen."""
    import pycolmap

    if count <= EXHAUSTIVE:
        say(f"matching all {count * (count - 1) // 2} pairs")
        pycolmap.match_exhaustive(database, verification_options=_verification())
        return "all pairs"
    pairs, how = _chosen(sift_descriptors(database), EXHAUSTIVE, in_order=in_order)
    say(f"matching {len(pairs)} pairs")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = _listed(pairs, work)
    pycolmap.match_image_pairs(
        database, pairing_options=pairing, verification_options=_verification()
    )
    return how


def _chosen(
    described: Mapping[str, NDArray[np.float32]], exhaustive: int, *, in_order: bool
) -> tuple[list[tuple[str, str]], str]:
    """The pairs of pictures to match, and in words how they were chosen.

    Args:
        described: (N, D) descriptors of each picture by name.
        exhaustive: up to how many pictures every pair is taken.
        in_order: see ``find_cameras``.
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


def _listed(pairs: Sequence[tuple[str, str]], work: Path) -> Path:
    """A file with the pairs, as COLMAP reads them."""
    file = work / "pairs.txt"
    file.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    return file


def _verification() -> pycolmap.TwoViewGeometryOptions:
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return options


def _verified(database: Path) -> dict[tuple[str, str], int]:
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


def _all_flat(database: Path) -> bool:
    """Whether a homography explains every pair, so that mapping would have no depth to go by."""
    import pycolmap

    kinds = pycolmap.TwoViewGeometryConfiguration
    flat = (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
    with pycolmap.Database.open(database) as opened:
        _, geometries = opened.read_two_view_geometries()
    return all(found.config in flat for found in geometries if len(found.inlier_matches))


def _map(
    database: Path, images: Path, work: Path, *, pairs: Mapping[tuple[str, str], int], say: Say
) -> tuple[str, list[pycolmap.Reconstruction], float] | None:
    """The better of global and incremental mapping; None where neither gives a model.

    Returns:
        "global" or "incremental", its models, and ``explained`` of the largest of them.
    """
    import pycolmap

    settings = pycolmap.GlobalPipelineOptions()
    settings.random_seed = SEED
    best = None
    models = _models(
        pycolmap.global_mapping, database, images, out=work / "global", options=settings
    )
    if models:
        share = explained(_largest(models), pairs)
        best = "global", models, share
        if share >= ENOUGH:
            return best
        say(f"global mapping explains {share:.0%} of the matches; trying incremental mapping")
    else:
        say("global mapping gives no model; trying incremental mapping")
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.random_seed = SEED
    # COLMAP's default drops models of fewer than 10 pictures.
    pipeline.min_model_size = 2
    models = _models(
        pycolmap.incremental_mapping, database, images, out=work / "incremental", options=pipeline
    )
    if models:
        share = explained(_largest(models), pairs)
        if best is None or share > best[2]:
            best = "incremental", models, share
    return best


def _largest(models: Sequence[pycolmap.Reconstruction]) -> pycolmap.Reconstruction:
    return max(models, key=lambda model: model.num_reg_images())


def explained(model: pycolmap.Reconstruction, pairs: Mapping[tuple[str, str], int]) -> float:
    """Share of the verified matches of all pairs that became points of the model.

    Args:
        model: with points and their tracks.
        pairs: number of verified matches of each pair of pictures.
    """
    names = {image.image_id: image.name for image in model.images.values()}
    shared: Counter[tuple[str, str]] = Counter()
    for point in model.points3D.values():
        seen = sorted({names[element.image_id] for element in point.track.elements})
        shared.update(combinations(seen, 2))
    became = 0
    for (first, second), count in pairs.items():
        became += min(count, shared[min(first, second), max(first, second)])
    return became / max(1, sum(pairs.values()))


def _models(
    mapping: Any, database: Path, images: Path, *, out: Path, options: Any
) -> list[pycolmap.Reconstruction]:
    """The models with at least two pictures that a mapping makes; none if it fails."""
    out.mkdir()
    try:
        found = mapping(database, images, out, options=options)
    except (RuntimeError, ValueError):
        return []
    models = [model for model in found.values() if model.num_reg_images() >= 2]
    for model in models:
        _settle(model)
    return [model for model in models if model.num_reg_images() >= 2]


def _settle(model: pycolmap.Reconstruction) -> None:
    """Deregister pictures that see too few points, then bundle-adjust the rest once more."""
    import pycolmap

    for image in list(model.images.values()):
        if image.has_pose and image.num_points3D < LEAST_POINTS:
            model.deregister_frame(image.frame_id)
    if model.num_reg_images() < 2:
        return
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    _adjust(model, options)
    images = [image for image in model.images.values() if image.has_pose]
    counts = [sum(image.camera_id == camera for image in images) for camera in model.cameras]
    if min(counts) >= REFINED_FROM:
        options.refine_principal_point = True
        _adjust(model, options)
    model.update_point_3d_errors()


def _adjust(model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions) -> None:
    """Bundle-adjust all registered pictures, silently, unlike pycolmap.bundle_adjustment."""
    import pycolmap

    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP's log off the terminal; what fails is raised or reported by the caller."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
