"""COLMAP projects: a model, its pictures, and the masks and depth maps beside them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.colmap_model import (
    ColmapModel,
    RegisteredImage,
    find_model,
    load_model,
    other_models,
)
from gvtools.scenes.images import IMAGE_SUFFIXES
from gvtools.scenes.matching import find_renamed, given_folder
from gvtools.scenes.photographs import PosedFrame, posed_scene
from gvtools.scenes.scene import Finding, Scene, SparsePoints, counted
from gvtools.scenes.undistort import LensParameters, Undistortion
from gvtools.untrusted import is_file, named_file

# Middle and side lengths of a chunk of Hierarchical-3DGS, world frame, scene units.
CHUNK_BOX = ("center.txt", "extent.txt")
# What a depth map is called after its picture; the first that exists is read.
DEPTH_SUFFIXES = (".geometric.bin", ".photometric.bin", ".npy", ".npz")


def read_colmap(
    root: Path, *, images: Path | None = None, masks: Path | None = None, model: int | None = None
) -> Scene:
    """A COLMAP project with every view in an undistorted pinhole camera.

    Pictures that see too much for one camera become several views, see ``undistort``.

    The model is looked for in ``sparse/N``, ``sparse``, ``root`` itself and ``sparse_txt``, the
    pictures in ``images`` beside it, those of a chunk of Hierarchical-3DGS (``chunks/NAME``) in
    ``rectified/images``. Masks follow COLMAP's layout (``masks/NAME.png`` for the image NAME, black
    = ignore). Depth comes from ``stereo/depth_maps`` (geometric before photometric); it is z-depth
    of the recorded camera, which in a dense workspace is the undistorted one already.
    The scene is in the model's frame and scale; ``model`` is its number, None for the largest.
    """
    root = Path(root)
    loaded = model_in(root, number=model, faces=True)
    folder = loaded.folder
    homes = _homes(root, folder)
    if images is not None:
        image_folder = given_folder(images, "images")
    elif (beside := _first(homes, "images")) is not None:
        image_folder = beside
    else:
        raise ProjectError(
            f"{folder}: a model without images: no folder 'images' in "
            f"{', '.join(str(home) for home in homes)}; give it with --images"
        )
    around = image_folder.parent
    mask_folder = (
        _first([around, *homes], "masks") if masks is None else given_folder(masks, "masks")
    )
    depth_folder = _first([*homes, around], "stereo/depth_maps")
    frames = colmap_frames(loaded, lambda image: image_folder / image.name)
    where = [f"{folder}, an image"] * len(frames)
    files, met = find_renamed(image_folder, [frame.image for frame in frames], where=where)
    frames = [replace(frame, image=file) for frame, file in zip(frames, files, strict=True)]
    if mask_folder is not None:
        listed = [mask_folder / f"{frame.name}.png" for frame in frames]
        where = [f"{mask_folder}, a mask"] * len(frames)
        found, others = find_renamed(mask_folder, listed, where=where, noun="masks")
        frames = [replace(frame, mask=mask) for frame, mask in zip(frames, found, strict=True)]
        met += others
    if depth_folder is not None:
        frames = [
            replace(frame, depth=depth_map_path(depth_folder, frame.name)) for frame in frames
        ]
    scene = colmap_scene(root, loaded, frames, strict=True)
    kinds = Counter(frame.depth.name.split(".")[-2] for frame in frames if frame.depth is not None)
    kinds_found = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    findings = [Finding("info", f"depth maps: {kinds_found}")] if kinds_found else []
    findings += [_registered_finding(image_folder, loaded, files), *other_models(root, folder)]
    return replace(scene, findings=(*scene.findings, *met, *findings))


def model_in(root: Path, *, number: int | None = None, faces: bool = False) -> ColmapModel:
    """The COLMAP model of a folder; see ``find_model`` and ``load_model``."""
    folder = find_model(root, number=number)
    if folder is None:
        raise ProjectError(
            f"{root}: no COLMAP model; expected cameras.bin or cameras.txt in sparse/0, in sparse "
            "or in the folder itself"
        )
    return load_model(folder, faces=faces)


def colmap_frames(
    model: ColmapModel, picture_of: Callable[[RegisteredImage], Path]
) -> list[PosedFrame]:
    """The model's images as frames, named as the model names them."""
    lenses: dict[int, LensParameters] = {}
    for key, camera in model.reconstruction.cameras.items():
        values = tuple(float(value) for value in camera.params)
        lenses[key] = LensParameters(camera.model_name, values, (camera.width, camera.height))
    return [
        PosedFrame(image.name, picture_of(image), lenses[image.camera_id], image.cam_from_world)
        for image in model.images
    ]


def colmap_scene(
    root: Path,
    model: ColmapModel,
    frames: list[PosedFrame],
    *,
    strict: bool = False,
    metric: bool = False,
) -> Scene:
    """The scene of a model's frames with its sparse points, detections in the views' pixels."""
    scene = posed_scene(
        root,
        frames,
        poses="cam_from_world",
        metric=metric,
        kind="colmap",
        strict=strict,
        findings=model.findings,
        advice="give the image folder with --images" if strict else "complete the download",
    )
    points, findings = _sparse_points(model, scene)
    return replace(scene, points=points, findings=(*scene.findings, *findings))


def _homes(root: Path, folder: Path) -> list[Path]:
    """Folders that may hold ``images``, ``masks`` and ``stereo``, nearest guess first."""
    homes = [root, folder, folder.parent]
    if folder.parent.name in ("sparse", "sparse_txt"):
        homes.append(folder.parent.parent)
    # A chunk of Hierarchical-3DGS, a part of a model with its box: all share the pictures.
    chunks = [home for home in homes if all((home / name).is_file() for name in CHUNK_BOX)]
    homes += [home.resolve().parents[1] / "rectified" for home in chunks]
    return list(dict.fromkeys(path.resolve() for path in homes))


def _first(homes: list[Path], name: str) -> Path | None:
    return next((home / name for home in homes if (home / name).is_dir()), None)


def _registered_finding(image_folder: Path, model: ColmapModel, files: list[Path]) -> Finding:
    """How many of the pictures on disk the model knows, and through which cameras."""
    known = {os.path.relpath(file, image_folder) for file in files if is_file(file)}
    others = 0
    for folder, _, inner in os.walk(image_folder):
        relative = Path(folder).relative_to(image_folder)
        for name in inner:
            if name.lower().endswith(IMAGE_SUFFIXES):
                others += (relative / name).as_posix() not in known
    models = Counter(views[0].model for views in model.views.values())
    cameras = ", ".join(f"{count} {name}" for name, count in sorted(models.items()))
    line = f"{len(known)} of {others + len(known)} pictures registered; cameras: {cameras}"
    return Finding("warning" if others > len(known) else "info", line)


def depth_map_path(folder: Path, name: str) -> Path | None:
    """The depth map of the image called ``name``; None when there is none."""
    for suffix in DEPTH_SUFFIXES:
        path = folder / f"{name}{suffix}"
        if is_file(path):
            home, file = Path(os.path.abspath(folder)), os.path.abspath(path)
            named_file(home, file, where=f"{folder}, a depth map", follow_links=True)
            return path
    return None


# --- sparse points ----------------------------------------------------------------------------


def _sparse_points(model: ColmapModel, scene: Scene) -> tuple[SparsePoints | None, list[Finding]]:
    """The model's points by id (None without any), tracks in the views' pixels, and findings."""
    points = model.reconstruction.points3D
    if not len(points):
        return None, [Finding("info", "the model has no sparse points")]
    ids = np.array(sorted(points), np.uint64)
    index = {name: i for i, name in enumerate(scene.names)}
    tracks = [_observations(model, image, scene, index=index, ids=ids) for image in model.images]
    point = np.concatenate([track[0] for track in tracks])
    view = np.concatenate([track[1] for track in tracks])
    xy = np.concatenate([track[2] for track in tracks])
    lost = model.reconstruction.compute_num_observations() - len(view)
    findings = counted(lost, "track elements belong to views that are not read", level="info")
    sound = np.isfinite(xy).all(axis=1)
    line = "detections lie where the lens has no inverse: dropped"
    findings += counted(int((~sound).sum()), line)
    # By point, then by view: the model's own order depends on its tables.
    rows = np.lexsort((view, point))
    rows = rows[sound[rows]]
    ordered = [points[int(key)] for key in ids]
    positions = np.array([item.xyz for item in ordered], np.float64)
    colors = np.array([item.color for item in ordered], np.uint8)
    errors = np.array([item.error for item in ordered], np.float32)
    tracks_of = SparsePoints(positions, colors, errors, point[rows], view[rows], xy[rows])
    return tracks_of, findings


def _observations(
    model: ColmapModel,
    image: RegisteredImage,
    scene: Scene,
    *,
    index: dict[str, int],
    ids: NDArray[np.uint64],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Point index, view index and pixels of all that one image saw."""
    lenses = model.views[image.camera_id]
    rows = [index[name] for name in (lens.name(image.name) for lens in lenses) if name in index]
    if not rows:
        return np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2))
    seen = model.reconstruction.images[image.image_id].get_observation_points2D()
    keys = np.fromiter((point.point3D_id for point in seen), np.uint64, len(seen))
    xy = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
    point_index = np.minimum(np.searchsorted(ids, keys), len(ids) - 1).astype(np.int32)
    strange = int((ids[point_index] != keys).sum())
    if strange:
        raise ProjectError(
            f"{model.folder}: {strange} detections of image {image.name} name points that "
            "points3D does not hold; expected files of one model; export the model again"
        )
    places = np.stack(
        [
            _of_view(lens, scene.views[row].camera.K[0], lens.points(xy))
            for lens, row in zip(lenses, rows, strict=True)
        ]
    )
    # Faces meet at their sides: the first that shows a detection takes it.
    shown = np.isfinite(places).all(-1).argmax(0)
    return point_index, np.array(rows, np.int32)[shown], places[shown, np.arange(len(xy))]


def _of_view(
    lens: Undistortion, K: NDArray[np.float64], xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 2) pixels of a model's pinhole camera as those of the view, which may be scaled."""
    if np.array_equal(lens.K, K):
        return xy
    change = K @ np.linalg.inv(lens.K)
    return np.asarray(xy @ change[:2, :2].T + change[:2, 2])
