"""``transforms.json`` of nerfstudio and instant-ngp, read and written.

The file's cameras have OpenGL axes (y up, z backward) and poses camera-to-world; its principal
point counts the first pixel's centre as (0.5, 0.5), as this project does.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gvtools.cameras import Cameras, invert_rigid, rigid_transform
from gvtools.errors import ProjectError, ShapeError
from gvtools.files import write_text
from gvtools.scenes.images import read_depth, read_header
from gvtools.scenes.lens_parameters import lens_parameters
from gvtools.scenes.photographs import (
    Photograph,
    header_findings,
    lens_findings,
    named,
    rotation_findings,
)
from gvtools.scenes.scene import Finding, Scene, natural_key
from gvtools.scenes.undistort import Undistortion, undistortion

FILE = "transforms.json"
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
MILLIMETRES = 1e-3
GUESSED_SUFFIXES = (".png", ".jpg", ".jpeg")  # Blender's files name pictures without a suffix


def read_transforms(path: Path, *, images: Path | None = None, masks: Path | None = None) -> Scene:
    """The project of a ``transforms.json``.

    Intrinsics may be shared or stand in each frame, as ``fl_x`` or as ``camera_angle_x``.
    Distorted cameras become pinhole cameras; depth (``depth_file_path``, times
    ``depth_unit_scale_factor``, 1e-3 when absent) and masks (``mask_path``, black = ignore) go
    through the same mapping. Views are named by their path below the deepest folder they share.

    Args:
        path: the file, or the folder with a ``transforms.json``.
        images: a folder to take the pictures from instead, by their path below the shared folder.
        masks: a folder with ``NAME.png`` for the view NAME, where frames name no mask.

    Returns:
        The scene, in the file's world frame and scale.

    Raises:
        ProjectError: no such file, malformed, without frames on disk, or a spherical camera.
        ShapeError: a pose with NaN, a scale or a mirror.
    """
    path = Path(path)
    path = path / FILE if path.is_dir() else path
    data = _load(path)
    frames = data["frames"]
    findings: list[Finding] = []
    files = [_picture(path.parent, frame, f"{path}, frame {i}") for i, frame in enumerate(frames)]
    shared = Path(os.path.commonpath([file.parent for file in files]))
    names = [file.relative_to(shared).as_posix() for file in files]
    if images is not None:
        if not Path(images).is_dir():
            raise ProjectError(f"{images}: no such image folder")
        files = [Path(images) / name for name in names]
    lenses: dict[tuple[Any, ...], Undistortion] = {}
    photographs, absent, defects = [], [], []
    for i, (frame, file, name) in enumerate(zip(frames, files, names, strict=True)):
        what = f"{path}, frame {i} ({name})"
        if not file.is_file():
            absent.append(name)
            continue
        pose, defect = rigid_transform(_matrix(frame, what), what=what)
        defects.append(defect)
        lens = _lens({**data, **frame}, file, what, lenses)
        mask, depth, lost = _beside(path.parent, frame, masks, name)
        if lost:
            findings.append(Finding("warning", f"{what}: {lost} is absent on disk"))
        unit = _number({**data, **frame}, "depth_unit_scale_factor", what, MILLIMETRES)
        photographs.append(
            Photograph(
                name,
                file,
                lens,
                invert_rigid(pose @ OPENCV_FROM_OPENGL),
                mask,
                depth,
                partial(read_depth, unit=unit),
            )
        )
    if not photographs:
        raise ProjectError(
            f"{path}: none of the pictures of its {len(frames)} frames is on disk (looked for "
            f"{named([str(file) for file in files])}); expected them there; give their folder with "
            "--images"
        )
    if absent:
        message = f"{len(absent)} of {len(frames)} frames are absent on disk: {named(absent)}"
        findings.append(Finding("warning", message))
    photographs.sort(key=lambda item: natural_key(item.name))
    findings += rotation_findings(defects)
    findings += lens_findings([item.lens for item in photographs])
    findings += header_findings([(item.image, item.lens.source_size) for item in photographs])
    views = tuple(item.view() for item in photographs)
    return Scene(path.parent, "transforms", views, None, tuple(findings), metric=False)


def write_transforms(
    path: Path,
    cameras: Cameras,
    *,
    image_paths: Sequence[str | Path],
    depth_paths: Sequence[str | Path] | None = None,
) -> None:
    """Write cameras as a ``transforms.json`` that nerfstudio, instant-ngp and this project read.

    Args:
        path: the file.
        cameras: V cameras; K without skew.
        image_paths: V pictures, absolute or relative to the file's folder.
        depth_paths: V depth maps in scene units (``.npy``), likewise.

    Raises:
        ShapeError: another number of paths than of cameras.
        ProjectError: the file cannot be written.
    """
    path = Path(path)
    depths = [None] * len(cameras) if depth_paths is None else list(depth_paths)
    if len(image_paths) != len(cameras) or len(depths) != len(cameras):
        raise ShapeError(
            f"transforms: {len(image_paths)} images and {len(depths)} depths for "
            f"{len(cameras)} cameras; expected one each"
        )
    frames = []
    for i, (image, depth) in enumerate(zip(image_paths, depths, strict=True)):
        K, pose = cameras.K[i], cameras.world_from_cam[i] @ OPENCV_FROM_OPENGL
        frame: dict[str, Any] = {
            "file_path": _relative(image, path.parent),
            "fl_x": K[0, 0],
            "fl_y": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "w": int(cameras.width[i]),
            "h": int(cameras.height[i]),
            "transform_matrix": pose.tolist(),
        }
        if depth is not None:
            frame["depth_file_path"] = _relative(depth, path.parent)
        frames.append(frame)
    data: dict[str, Any] = {"camera_model": "PINHOLE"}
    if depth_paths is not None:
        data["depth_unit_scale_factor"] = 1.0
    text = json.dumps({**data, "frames": frames}, indent=2)
    write_text(path, text)


def _relative(file: str | Path, folder: Path) -> str:
    if not Path(file).is_absolute():
        return Path(file).as_posix()
    return Path(os.path.relpath(file, folder.resolve())).as_posix()


def _load(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ProjectError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise ProjectError(f"{path}: no JSON ({error}); expected a transforms.json") from None
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise ProjectError(f"{path}: no list 'frames'; expected a transforms.json")
    if not frames:
        raise ProjectError(f"{path}: no frames; expected at least one posed picture")
    return data


def _picture(folder: Path, frame: dict[str, Any], what: str) -> Path:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise ProjectError(f"{what}: no file_path; expected the picture's path")
    file = Path(os.path.normpath(folder / name.replace("\\", "/")))
    if file.is_file() or file.suffix.lower() in GUESSED_SUFFIXES:
        return file
    guesses = [file.with_name(file.name + suffix) for suffix in GUESSED_SUFFIXES]
    return next((guess for guess in guesses if guess.is_file()), guesses[0])


def _matrix(frame: dict[str, Any], what: str) -> np.ndarray:
    try:
        return np.array(frame["transform_matrix"], np.float64)
    except KeyError:
        raise ProjectError(f"{what}: no transform_matrix; expected a 4x4 pose") from None
    except (TypeError, ValueError):
        raise ProjectError(f"{what}: transform_matrix is no matrix; expected 4x4 numbers") from None


def _lens(
    values: dict[str, Any], file: Path, what: str, known: dict[tuple[Any, ...], Undistortion]
) -> Undistortion:
    """The frame's camera; frames with equal intrinsics share one mapping."""
    width, height = _size(values, file, what)
    model, focal = str(values.get("camera_model", "")), _focal(values, width, what)
    params = lens_parameters(
        {key: value for key, value in values.items() if key not in ("frames", "transform_matrix")},
        focal=focal,
        center=(
            _number(values, "cx", what, width / 2),
            _number(values, "cy", what, height / 2),
        ),
        what=what,
    )
    key = (model, params, width, height)
    if key not in known:
        known[key] = undistortion(params.model, params.values, (width, height), what=what)
    return known[key]


def _size(values: dict[str, Any], file: Path, what: str) -> tuple[int, int]:
    if "w" in values and "h" in values:
        return round(_number(values, "w", what)), round(_number(values, "h", what))
    header = read_header(file)
    return header.width, header.height


def _focal(values: dict[str, Any], width: int, what: str) -> tuple[float, float]:
    if "fl_x" in values or "fl_y" in values:
        x = _number(values, "fl_x" if "fl_x" in values else "fl_y", what)
        return x, _number(values, "fl_y", what, x)
    if "camera_angle_x" not in values:
        raise ProjectError(f"{what}: neither fl_x nor camera_angle_x; expected one of them")
    x = 0.5 * width / math.tan(0.5 * _number(values, "camera_angle_x", what))
    return x, x


def _number(values: dict[str, Any], key: str, what: str, default: float | None = None) -> float:
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ProjectError(f"{what}: {key} is {value!r}; expected a number")
    return float(value)


def _beside(
    folder: Path, frame: dict[str, Any], masks: Path | None, name: str
) -> tuple[Path | None, Path | None, str]:
    """Mask and depth of a frame, and which of the files that it names is absent."""
    mask = folder / frame["mask_path"] if frame.get("mask_path") else None
    depth = folder / frame["depth_file_path"] if frame.get("depth_file_path") else None
    lost = ", ".join(path.name for path in (mask, depth) if path and not path.is_file())
    if mask is None and masks is not None:
        mask = Path(masks) / f"{name}.png"
    return (
        mask if mask is not None and mask.is_file() else None,
        depth if depth is not None and depth.is_file() else None,
        lost,
    )
