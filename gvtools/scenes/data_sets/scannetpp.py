"""ScanNet++ v2: ``[data/]SCENE/dslr`` and ``[data/]SCENE/iphone``, each a scene of its own.

DSLR: poses and the fisheye camera come from ``dslr/colmap``, whose world is the laser scan's, in
metres (that of ``nerfstudio/transforms.json`` is another). Pictures that the data set's tools
undistorted (``resized_undistorted_images`` with ``nerfstudio/transforms_undistorted.json``) are
read where they are there, else ``resized_images`` are undistorted here. ``render_depth`` of the
tools (millimetres) is of the fisheye pictures and is read with those alone. Anonymisation masks
(``resized_anon_masks``) are read with either.

iPhone: ``iphone/rgb`` and ``iphone/depth`` (millimetres, 256x192) as the data set's tools extract
them from ``rgb.mp4`` and ``depth.bin``, with ``pose_intrinsic_imu.json``: ``aligned_pose`` is
world_from_cam with OpenCV axes in the scan's world, ``intrinsic`` is of the picture.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.colmap_files import has_model
from gvtools.scenes.colmap_model import RegisteredImage
from gvtools.scenes.data_sets.colmap_pictures import colmap_pictures, colmap_scene, model_in
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.mvsnet_cameras import picture_size
from gvtools.scenes.data_sets.nerfstudio_pictures import nerfstudio_pictures
from gvtools.scenes.data_sets.posed_pictures import (
    Float64,
    PosedPicture,
    natural,
    pinhole_lens,
    posed_scene,
)
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import read_depth
from gvtools.scenes.rgbd_recording import MILLIMETRES
from gvtools.scenes.scene import Scene
from gvtools.untrusted import is_file, read_json

POSES = "pose_intrinsic_imu.json"
UNDISTORTED = Path("nerfstudio") / "transforms_undistorted.json"


def _scenes(root: Path) -> tuple[str, ...]:
    found = [
        path
        for pattern in ("*/dslr/", "*/iphone/", "data/*/dslr/", "data/*/iphone/")
        for path in root.glob(pattern)
        if has_model(path / "colmap") or (path / POSES).is_file()
    ]
    return natural(path.relative_to(root).as_posix() for path in found)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    return _dslr(folder) if folder.name == "dslr" else _iphone(folder)


def _dslr(folder: Path) -> Scene:
    model = model_in(folder / "colmap")
    home, masks = folder / "resized_undistorted_images", folder / "resized_undistorted_masks"
    undistorted = (folder / UNDISTORTED).is_file() and home.is_dir()
    if not undistorted:
        home, masks = folder / "resized_images", folder / "resized_anon_masks"

    def picture_of(image: RegisteredImage) -> Path:
        return home / Path(image.name).name

    pictures = colmap_pictures(model, picture_of)
    if undistorted:
        keys = ("frames", "test_frames")
        frames = nerfstudio_pictures(folder / UNDISTORTED, lambda name: home / name, keys=keys)
        lenses = {frame.name: frame.lens for frame in frames}
        # Poses stay those of COLMAP: a pinhole looks along the fisheye camera's own axes.
        pictures = [replace(item, lens=lenses.get(Path(item.name).name)) for item in pictures]
    elif (folder / "render_depth").is_dir():
        pictures = [_with_depth(item, folder / "render_depth") for item in pictures]
    pictures = [_with_mask(item, masks) for item in pictures]
    return colmap_scene(folder, model, pictures, metric=True)


def _with_mask(picture: PosedPicture, folder: Path) -> PosedPicture:
    mask = folder / f"{Path(picture.name).stem}.png"
    return replace(picture, mask=mask) if is_file(mask) else picture


def _with_depth(picture: PosedPicture, folder: Path) -> PosedPicture:
    depth = folder / f"{Path(picture.name).stem}.png"
    return replace(picture, depth=depth, read_depth=partial(read_depth, unit=MILLIMETRES))


def _iphone(folder: Path) -> Scene:
    if not (folder / "rgb").is_dir():
        raise ProjectError(
            f"{folder}: no folder rgb; extract it from rgb.mp4 (and depth from depth.bin) with the "
            "data set's own tool, iphone.prepare_iphone_data"
        )
    records = _records(folder / POSES)
    depths = folder / "depth"
    size = (1920, 1440)
    for name in records:
        size = picture_size(folder / "rgb" / f"{name}.jpg")
        if size > (2, 2):
            break
    pictures = []
    for name, record in records.items():
        K = _matrix(record.get("intrinsic"), 3)
        pictures.append(
            PosedPicture(
                f"{name}.jpg",
                folder / "rgb" / f"{name}.jpg",
                None if K is None else pinhole_lens(K, size),
                _matrix(record.get("aligned_pose"), 4),
                depths / f"{name}.png" if depths.is_dir() else None,
                partial(read_depth, unit=MILLIMETRES),
            )
        )
    return posed_scene(folder, pictures, poses="world_from_cam", metric=True)


def _records(path: Path) -> dict[str, dict[str, Any]]:
    try:
        data = read_json(path)
        return {str(name): dict(record) for name, record in data.items()}
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise ProjectError(f"{path}: {error}; expected a record for each frame") from None


def _matrix(value: Any, side: int) -> Float64 | None:
    """(side, side) float64, or None where there is no such matrix."""
    try:
        return np.array(value, np.float64).reshape(side, side)
    except (TypeError, ValueError):
        return None


LAYOUT = Layout(f"SCENE/dslr/colmap or SCENE/iphone/{POSES} with pictures", _scenes, _read)
