"""Hypersim: ``SCENE/_detail/cam_XX`` (HDF5) with ``SCENE/images/scene_cam_XX_*``.

Cameras look along -z with y up (OpenGL axes), ``camera_keyframe_orientations.hdf5`` holds rotations
world_from_cam, and positions are in asset units; ``_detail/metadata_scene.csv`` has the metres per
unit. ``depth_meters`` is the distance from the camera's centre, not z, in metres, NaN for none.
Colour is the linear ``final_hdf5/frame.IIII.color.hdf5`` with the tone curve that the data set's
tools use, or else the JPEG preview ``final_preview/frame.IIII.tonemap.jpg``.

A scene's intrinsics are in ``metadata_camera_parameters.csv`` (from the data set's repository; it
is looked for in the root and the folder above) as a 3x3 matrix that takes u (right) and v (up),
both from -1 to 1 across the picture, to a ray. With a tilted (tilt-shift) lens the image plane is
not perpendicular to the viewing direction. Such a camera equals an ordinary pinhole that looks
along the image plane's normal. So the matrix is split (QR) into a rotation, which goes into the
pose, and an upper triangular K; pictures stay as they are, and z is along the rotated axis. A lens
that is tilted about both axes has a skew in K besides: rows of its pictures and depth maps are
shifted sideways, so that K has none. Without the file, the published horizontal field of view of 60
degrees is taken, and a finding says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import rigid_poses
from gvtools.errors import ProjectError
from gvtools.scenes.calibration import Float64, csv_rows, opencv_pose, pinhole_lens
from gvtools.scenes.images import hdf5_array, read_image, readings
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import natural
from gvtools.scenes.photographs import Depth, PosedFrame, posed_scene
from gvtools.scenes.scene import Finding, Frame, Scene
from gvtools.scenes.undistort import LensParameters
from gvtools.untrusted import read_text, reading

PARAMETERS = "metadata_camera_parameters.csv"
SIZE = (1024, 768)  # width, height of the pictures where the file of parameters is absent
FIELD_OF_VIEW = math.radians(60)  # horizontal, of scenes without lens shift
SKEW = 1e-6  # smaller values of TurnedPinhole.slope are rounding errors
# The tone curve: colours are scaled so that this percentile of the pixels' brightness is displayed
# as this share of white, after gamma.
PERCENTILE, BRIGHTNESS, GAMMA = 90, 0.8, 2.2
DARK = 1e-4  # a picture whose percentile is not above this becomes black
NO_ENTITY = -1  # in render_entity_id: the pixel shows no object


def _scenes(root: Path) -> tuple[str, ...]:
    found = root.glob("*/_detail/cam_*/camera_keyframe_positions.hdf5")
    return natural(f"{path.parents[2].name}/{path.parent.name}" for path in found)


@Layout.of_reader("ai_VVV_NNN/_detail/cam_XX with ai_VVV_NNN/images", _scenes)
def _hypersim(root: Path, scene: str) -> Scene:
    name, _, camera = scene.partition("/")
    detail, images = root / name / "_detail", root / name / "images"
    parameters = _parameters(root, name)
    unit = _metres_per_unit(detail / "metadata_scene.csv", parameters)
    uv, size, findings = _projection(parameters)
    turned = turned_pinhole(uv, size)
    findings += _turn_findings(turned)
    orientations = _hdf5(detail / camera / "camera_keyframe_orientations.hdf5")
    positions = _hdf5(detail / camera / "camera_keyframe_positions.hdf5") * unit
    numbers = detail / camera / "camera_keyframe_frame_indices.hdf5"
    indices = [int(i) for i in _hdf5(numbers)] if numbers.is_file() else range(len(positions))
    geometry = images / f"scene_{camera}_geometry_hdf5"
    frames, reader = [], partial(read_distance, camera=turned)
    for index, rotation, position in zip(indices, orientations, positions, strict=True):
        pose = opencv_pose(rigid_poses(rotation, position))
        pose[:3, :3] = pose[:3, :3] @ turned.stored_from_turned
        stem = f"frame.{index:04d}"
        color, read = _color(images, camera, stem, turned=turned)
        depth = geometry / f"{stem}.depth_meters.hdf5" if geometry.is_dir() else None
        frames.append(PosedFrame(stem, color, turned.lens, pose, depth, reader, read=read))
    place = root / scene
    return posed_scene(
        place, frames, poses="world_from_cam", metric=True, findings=findings, home=root
    )


@dataclass(frozen=True)
class TurnedPinhole:
    """The pinhole that equals a camera with a tilted lens."""

    lens: LensParameters  # intrinsics of the pinhole, pixels
    # (3, 3) rotation from the pinhole's axes to those of the stored pose, both OpenCV.
    stored_from_turned: Float64
    # Pixels by which each row of the stored picture is shifted right against the row above (skew /
    # fy); 0 for none.
    slope: float

    def straight(self, values: NDArray[Any], *, nearest: bool) -> NDArray[Any]:
        """A stored picture or map (h, w, ...) with its rows shifted against skew; 0 outside."""
        import cv2

        if not self.slope:
            return values
        height, width = values.shape[:2]
        shift = self.slope * (0.5 - self.lens.values[3])
        back = np.array([[1, self.slope, shift], [0, 1, 0]])
        how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        return cv2.warpAffine(values, back, (width, height), flags=how | cv2.WARP_INVERSE_MAP)


def turned_pinhole(cam_from_uv: Float64, size: tuple[int, int]) -> TurnedPinhole:
    """Split (3, 3), from (u, v, 1) to a ray, into a rotation and a pinhole; see the module."""
    width, height = size
    uv_from_pixel = np.array([[2 / width, 0, -1], [0, -2 / height, 1], [0, 0, 1]])
    ray = np.diag([1.0, -1, -1]) @ np.asarray(cam_from_uv, np.float64) @ uv_from_pixel
    rotation, upper = np.linalg.qr(ray)
    sign = np.sign(np.diag(upper))
    rotation, upper = rotation * sign, upper * sign[:, None]
    if not np.linalg.det(rotation) > 0:
        raise ProjectError(
            f"{PARAMETERS}: the projection {ray.tolist()} is a mirror or has no "
            "inverse; copy the file again"
        )
    K = np.linalg.inv(upper / upper[2, 2])
    slope = float(K[0, 1] / K[1, 1])
    return TurnedPinhole(pinhole_lens(K, size), rotation, slope if abs(slope) > SKEW else 0.0)


def read_distance(path: Path, *, camera: TurnedPinhole) -> Depth:
    """``depth_meters`` as (h, w) float32 depth along the pinhole's z, metres; 0 for none."""
    distance = camera.straight(np.nan_to_num(_hdf5(path).astype(np.float32)), nearest=True)
    fx, fy, cx, cy = camera.lens.values
    height, width = distance.shape
    scale = camera.lens.size[0] / width, camera.lens.size[1] / height
    x = ((np.arange(width) + 0.5) * scale[0] - cx) / fx
    y = ((np.arange(height) + 0.5) * scale[1] - cy) / fy
    return readings(distance / np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2))


def read_color(path: Path) -> Frame:
    """A picture of linear colour through the tone curve of the data set's tools.

    The 90th percentile of the pixels' brightness becomes 0.8 of white. Pixels that show no object
    do not count, where the scene's ``render_entity_id`` is there.
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


def read_straight(path: Path, *, camera: TurnedPinhole, reader: Callable[[Path], Frame]) -> Frame:
    """A picture without skew; its mask is False where the stored picture has no pixel."""
    frame = reader(path)
    rgb = camera.straight(frame.rgb, nearest=False)
    seen = camera.straight(np.ones(rgb.shape[:2], np.uint8), nearest=True)
    return Frame(rgb, mask=seen > 0)


def _color(
    images: Path, camera: str, stem: str, *, turned: TurnedPinhole
) -> tuple[Path, Callable[[Path], Frame] | None]:
    """The file of a frame's colour, and what reads it; None for the usual reader of pictures."""
    linear = images / f"scene_{camera}_final_hdf5" / f"{stem}.color.hdf5"
    preview = images / f"scene_{camera}_final_preview" / f"{stem}.tonemap.jpg"
    path, reader = (linear, read_color) if linear.is_file() else (preview, read_image)
    if turned.slope:
        return path, partial(read_straight, camera=turned, reader=reader)
    return path, reader if reader is read_color else None


def _turn_findings(turned: TurnedPinhole) -> list[Finding]:
    findings = []
    turn = turned.stored_from_turned
    if np.abs(turn - np.eye(3)).max() > 1e-9:
        angle = math.degrees(math.acos(min(1.0, turn[2, 2])))
        line = f"tilted lens: cameras are turned by {angle:.3g} degrees to pinholes"
        findings.append(Finding("info", line))
    if turned.slope:
        most = abs(turned.slope) * turned.lens.size[1] / 2
        line = f"skewed pixels: rows are moved sideways by up to {most:.2g} px to those of pinholes"
        findings.append(Finding("info", line))
    return findings


def _parameters(root: Path, scene: str) -> dict[str, str]:
    """The scene's line in the file of camera parameters; empty where that is absent."""
    paths = (folder / PARAMETERS for folder in (root, root.resolve().parent))
    path = next((path for path in paths if path.is_file()), None)
    rows = [] if path is None else csv_rows(path)
    return next((row for row in rows if row.get("scene_name") == scene), {})


def _projection(parameters: dict[str, str]) -> tuple[Float64, tuple[int, int], list[Finding]]:
    """(3, 3) matrix from (u, v, 1) to a ray, the pictures' width and height, and findings."""
    if not parameters:
        x = math.tan(FIELD_OF_VIEW / 2)
        line = f"no {PARAMETERS} with this scene: 60 degrees across are taken, without lens shift"
        uv = np.diag([x, x * SIZE[1] / SIZE[0], -1.0])
        return uv, SIZE, [Finding("warning", line)]
    with reading(PARAMETERS, "copy the file again"):
        names = [f"M_cam_from_uv_{row}{column}" for row in range(3) for column in range(3)]
        uv = np.array([float(parameters[name]) for name in names]).reshape(3, 3)
        sides = (parameters[f"settings_output_img_{side}"] for side in ("width", "height"))
        width, height = (int(float(side)) for side in sides)
        return uv, (width, height), []


def _metres_per_unit(path: Path, parameters: dict[str, str]) -> float:
    texts = [parameters.get("settings_units_info_meters_scale") or ""]
    if path.is_file():
        words = (line.split(",") for line in read_text(path, errors="replace").splitlines())
        texts = [row[1] for row in words if row[0] == "meters_per_asset_unit" and row[1:]] + texts
    for text in texts:
        # An interrupted download may end before the number.
        with suppress(ValueError):
            return float(text)
    raise ProjectError(
        f"{path}: no meters_per_asset_unit, without which poses and depth have different units; "
        "complete the download"
    )


def _hdf5(path: Path) -> Any:
    """The array of an HDF5 file, which all of Hypersim's call "dataset"."""
    return hdf5_array(path, "dataset")


LAYOUTS = (_hypersim,)
