"""Cameras from photographs: features, matching and mapping by pycolmap.

Global mapping (GLOMAP, Pan et al. 2024) solves for all cameras at once. It can end in a model whose
parts have different scales, with every picture registered and small reprojection errors (the fox of
instant-ngp: camera centres wrong by 35 % of their extent, reprojection errors of 0.5 pixels). The
share of verified matches that became 3D points reveals such a model: 69 % there, 94 % in the right
one. If that share is low, incremental mapping is tried as well, and the model with the larger share
is kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.capture.matching import MappingTask, flat_pairs, match_pictures, only_turned, verified
from gvtools.errors import ProjectError
from gvtools.features import quiet_colmap
from gvtools.poses.colmap import SEED, adjust, fix_cameras

if TYPE_CHECKING:
    import pycolmap

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

Pairs = Mapping[tuple[str, str], int]  # number of verified matches of pairs of pictures, by names


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
    from gvtools.colmap import pycolmap

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
    from gvtools.colmap import pycolmap

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
        if how == "global" and not models:
            task.say("global mapping gives no model; trying incremental mapping")
        elif how == "global" and share >= ENOUGH:
            break
        elif how == "global":
            task.say(
                f"global mapping explains {share:.0%} of the matches; trying incremental mapping"
            )
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
    from gvtools.colmap import pycolmap

    if model.num_reg_images() < 2:
        return
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
