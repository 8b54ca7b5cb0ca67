"""Hypersim: ``SCENE/_detail/cam_XX`` (HDF5) with ``SCENE/images/scene_cam_XX_*``.

Cameras look along -z with y up, ``camera_keyframe_orientations.hdf5`` is world_from_cam, and
positions are in asset units, which ``_detail/metadata_scene.csv`` converts to metres.
``depth_meters`` is the distance from the camera's centre, not z, in metres, NaN for none. Colour is
``final_hdf5/frame.IIII.color.hdf5`` with the tone curve that the data set's tools use, or else
the JPEG preview ``final_preview/frame.IIII.tonemap.jpg``.

A scene's intrinsics stand in ``metadata_camera_parameters.csv`` (of the data set's repository; it
is looked for in the root and above) as a 3x3 matrix that takes u (right) and v (up), both from -1
to 1 across the picture, to a ray. With a tilted lens the picture's plane is not square to the view.
Such a camera is a pinhole all the same, one that is turned: matrix and orientation are split anew,
so that nothing is resampled, and z is along the turned axis. Without the file the published 60
degrees are taken, which a finding tells.
"""

from __future__ import annotations

import csv
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import (
    OPENCV_FROM_OPENGL,
    Float64,
    PosedPicture,
    natural,
    pinhole_lens,
    posed_scene,
)
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.photographs import Depth
from gvtools.scenes.scene import Finding, Frame, Scene
from gvtools.scenes.transforms_frame import LensParameters

if TYPE_CHECKING:
    from types import ModuleType

PARAMETERS = "metadata_camera_parameters.csv"
SIZE = (1024, 768)
FIELD_OF_VIEW = math.radians(60)  # horizontal, of scenes without lens shift
SKEW = 1e-6  # of a focal length; a pinhole has none
# The tone curve: this share of pixels is below this brightness, after the display's gamma.
PERCENTILE, BRIGHTNESS, GAMMA = 90, 0.8, 2.2
DARK = 1e-4  # a picture whose brightness is below this stays black
NO_ENTITY = -1


def _scenes(root: Path) -> tuple[str, ...]:
    found = [
        f"{path.parent.parent.name}/{path.name}"
        for path in root.glob("*/_detail/cam_*/")
        if (path / "camera_keyframe_positions.hdf5").is_file()
    ]
    return natural(found)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    name, _, camera = scene.partition("/")
    detail, images = root / name / "_detail", root / name / "images"
    parameters = _parameters(root, name)
    unit = _metres_per_unit(detail / "metadata_scene.csv", parameters)
    uv, size, findings = _projection(parameters)
    lens, turn = turned_pinhole(uv, size, what=scene)
    if turn is not None:
        angle = math.degrees(math.acos(min(1.0, turn[2, 2])))
        line = f"tilted lens: cameras are turned by {angle:.3g} degrees to pinholes"
        findings.append(Finding("info", line))
    orientations = _hdf5(detail / camera / "camera_keyframe_orientations.hdf5")
    positions = _hdf5(detail / camera / "camera_keyframe_positions.hdf5") * unit
    indices = _frame_indices(detail / camera, len(positions))
    geometry = images / f"scene_{camera}_geometry_hdf5"
    frames = []
    for index, rotation, position in zip(indices, orientations, positions, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, position
        pose = pose @ OPENCV_FROM_OPENGL
        if turn is not None:
            pose[:3, :3] = pose[:3, :3] @ turn
        stem = f"frame.{index:04d}"
        color, read = _color(images, camera, stem)
        frames.append(
            PosedPicture(
                stem,
                color,
                lens,
                pose,
                geometry / f"{stem}.depth_meters.hdf5" if geometry.is_dir() else None,
                partial(read_distance, lens=lens),
                read=read,
            )
        )
    return posed_scene(root / scene, frames, poses="world_from_cam", metric=True, findings=findings)


def turned_pinhole(
    cam_from_uv: Float64, size: tuple[int, int], *, what: str
) -> tuple[LensParameters, Float64 | None]:
    """The pinhole of a perspective camera whose picture may be tilted.

    Args:
        cam_from_uv: (3, 3), from u, v, 1 to a ray; x right, y up, z backward.
        size: width and height of the picture, pixels.
        what: for the message.

    Returns:
        The lens, and the (3, 3) rotation from the turned camera to the stored one, OpenCV axes;
        None where the picture is square to the view.

    Raises:
        ProjectError: pixels are skewed, so that no pinhole takes such a picture.
    """
    width, height = size
    uv_from_pixel = np.array([[2 / width, 0, -1], [0, -2 / height, 1], [0, 0, 1]])
    ray = np.diag([1.0, -1, -1]) @ np.asarray(cam_from_uv, np.float64) @ uv_from_pixel
    rotation, upper = np.linalg.qr(ray)
    sign = np.sign(np.diag(upper))
    rotation, upper = rotation * sign, upper * sign[:, None]
    if np.linalg.det(rotation) < 0:
        raise ProjectError(f"{what}: a mirrored projection in {PARAMETERS}; copy the file again")
    K = np.linalg.inv(upper / upper[2, 2])
    if abs(K[0, 1]) > SKEW * K[0, 0]:
        raise ProjectError(
            f"{what}: its lens is tilted both ways, so that pixels are skewed by {K[0, 1]:.3g} "
            "px; no pinhole takes such pictures; leave the scene out"
        )
    square = np.abs(rotation - np.eye(3)).max() < 1e-12
    return pinhole_lens(K, size), None if square else rotation


def read_distance(path: Path, *, lens: LensParameters) -> Depth:
    """``depth_meters`` as (h, w) float32 z-depth, metres, of a pinhole; 0 for none.

    Raises:
        ProjectError: absent or damaged.
        OptionError: h5py is not installed.
    """
    distance = _hdf5(path)
    fx, fy, cx, cy = lens.values
    height, width = distance.shape
    scale = lens.size[0] / width, lens.size[1] / height
    x = ((np.arange(width) + 0.5) * scale[0] - cx) / fx
    y = ((np.arange(height) + 0.5) * scale[1] - cy) / fy
    z = distance / np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
    return np.where(np.isfinite(z) & (z > 0), z, 0).astype(np.float32)


def read_color(path: Path) -> Frame:
    """A picture of linear colour through the tone curve of the data set's tools.

    The brightness below which 90 % of the pixels lie becomes 0.8 of the display's; pixels that show
    nothing do not count, where the scene's ``render_entity_id`` is there to tell.

    Raises:
        ProjectError: absent or damaged.
        OptionError: h5py is not installed.
    """
    color = np.nan_to_num(_hdf5(path).astype(np.float32), posinf=0.0, neginf=0.0)
    shown = color @ np.array([0.3, 0.59, 0.11], np.float32)
    ids = path.parent.parent / path.parent.name.replace("_final_", "_geometry_")
    ids /= path.name.replace(".color.", ".render_entity_id.")
    if ids.is_file():
        shown = shown[_hdf5(ids) != NO_ENTITY]
    brightness = np.percentile(shown, PERCENTILE) if shown.size else BRIGHTNESS**GAMMA
    scale = BRIGHTNESS**GAMMA / brightness if brightness > DARK else 0.0
    display = np.clip(np.maximum(scale * color, 0) ** (1 / GAMMA), 0, 1)
    return Frame(np.rint(display * 255).astype(np.uint8))


def _color(images: Path, camera: str, stem: str) -> tuple[Path, partial[Frame] | None]:
    """The picture of a frame, and its reader; None for a picture file."""
    linear = images / f"scene_{camera}_final_hdf5" / f"{stem}.color.hdf5"
    preview = images / f"scene_{camera}_final_preview" / f"{stem}.tonemap.jpg"
    return (linear, partial(read_color)) if linear.is_file() else (preview, None)


def _frame_indices(folder: Path, count: int) -> list[int]:
    """Numbers in the names of a camera's frames."""
    path = folder / "camera_keyframe_frame_indices.hdf5"
    return [int(i) for i in _hdf5(path)] if path.is_file() else list(range(count))


def _parameters(root: Path, scene: str) -> dict[str, str]:
    """The scene's line in the file of camera parameters; empty where that is absent."""
    for folder in (root, root.resolve().parent):
        path = folder / PARAMETERS
        if path.is_file():
            with path.open(newline="", encoding="utf-8") as file:
                found = (row for row in csv.DictReader(file) if row["scene_name"] == scene)
                return next(found, {})
    return {}


def _projection(parameters: dict[str, str]) -> tuple[Float64, tuple[int, int], list[Finding]]:
    """(3, 3) matrix from u, v, 1 to a ray, the pictures' size, and what was met."""
    if not parameters:
        x = math.tan(FIELD_OF_VIEW / 2)
        line = f"no {PARAMETERS} with this scene: 60 degrees across are taken, without lens shift"
        uv = np.diag([x, x * SIZE[1] / SIZE[0], -1.0])
        return uv, SIZE, [Finding("warning", line)]
    try:
        names = [f"M_cam_from_uv_{row}{column}" for row in range(3) for column in range(3)]
        uv = np.array([float(parameters[name]) for name in names]).reshape(3, 3)
        size = [
            int(float(parameters[f"settings_output_img_{side}"])) for side in ("width", "height")
        ]
    except (KeyError, ValueError) as error:
        raise ProjectError(f"{PARAMETERS}: {error}; copy the file again") from None
    return uv, (size[0], size[1]), []


def _metres_per_unit(path: Path, parameters: dict[str, str]) -> float:
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.reader(file):
                if row[:1] == ["meters_per_asset_unit"]:
                    return float(row[1])
    if "settings_units_info_meters_scale" in parameters:
        return float(parameters["settings_units_info_meters_scale"])
    raise ProjectError(
        f"{path}: no meters_per_asset_unit, without which poses and depth have different units; "
        "complete the download"
    )


def _hdf5(path: Path) -> Float64:
    """The data set of a file, as stored."""
    try:
        with _h5py().File(path, "r") as file:
            return np.asarray(file["dataset"])
    except (OSError, KeyError) as error:
        raise ProjectError(f"{path}: unreadable ({error}); copy it again") from None


def _h5py() -> ModuleType:
    try:
        import h5py
    except ImportError:
        raise OptionError("reading Hypersim needs h5py; pip install h5py") from None
    return h5py


LAYOUT = Layout("ai_VVV_NNN/_detail/cam_XX with ai_VVV_NNN/images", _scenes, _read)
