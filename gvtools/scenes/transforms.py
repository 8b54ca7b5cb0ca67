"""``transforms.json`` of nerfstudio and instant-ngp, read and written.

The file's cameras have OpenGL axes (y up, z backward) and poses camera-to-world; its principal
point counts the first pixel's centre as (0.5, 0.5), as this project does.
"""

from __future__ import annotations

import json
import math
import os
import reprlib
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from gvtools.cameras import Cameras, invert_rigid, rigid_transform
from gvtools.errors import ProjectError
from gvtools.files import write_text
from gvtools.scenes.faces import PANORAMA, perspective_views
from gvtools.scenes.images import read_depth, read_header
from gvtools.scenes.matching import named
from gvtools.scenes.photographs import (
    Photograph,
    given_folder,
    header_findings,
    lens_findings,
    mask_findings,
    rotation_findings,
)
from gvtools.scenes.scene import Finding, Scene, natural_key
from gvtools.scenes.undistort import LensParameters, Undistortion
from gvtools.untrusted import named_file, read_json

FILE = "transforms.json"
EXPORTER = "gvtools"  # the value of ``exported_by`` in files written here
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
GUESSED_SUFFIXES = (".png", ".jpg", ".jpeg")  # Blender's files name pictures without a suffix

# nerfstudio's names; the fisheye ones share one model, the others the polynomial one.
PERSPECTIVE = ("", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

# Keys that each frame has for itself.
OF_A_FRAME = ("transform_matrix", "mask_path", "depth_file_path")

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
Pixels = Annotated[Number, Field(ge=1, le=200_000, multiple_of=1)]
Angle = Annotated[Number, Field(gt=0, lt=math.pi)]


def read_transforms(path: Path, *, images: Path | None = None, masks: Path | None = None) -> Scene:
    """The project of a ``transforms.json``.

    Intrinsics may be shared or stand in each frame, as ``fl_x`` or as ``camera_angle_x``.
    Distorted cameras become pinhole cameras, panoramas and wide fisheyes several (``faces``);
    depth (``depth_file_path``, times ``depth_unit_scale_factor``, 1e-3 when absent) and masks
    (``mask_path``, black = ignore) go through the same mapping. Views are named by
    their path below the deepest folder they share.

    Args:
        path: the file, or the folder with a ``transforms.json``.
        images: a folder to take the pictures from instead, by their path below the shared folder.
        masks: a folder with ``NAME.png`` for the view NAME, where frames name no mask.

    Returns:
        The scene, in the file's world frame and scale.
    """
    path = Path(path)
    path = path / FILE if path.is_dir() else path
    data = load_frames(path)
    frames = data["frames"]
    findings: list[Finding] = []
    files = [_picture(path.parent, frame, f"{path}, frame {i}") for i, frame in enumerate(frames)]
    names = _names(files)
    masks = None if masks is None else given_folder(masks, "masks")
    home = path.parent
    if images is not None:
        if not Path(images).is_dir():
            raise ProjectError(f"{images}: no such image folder")
        home = Path(images)
        files = [home / name for name in names]
    for i, file in enumerate(files):
        named_file(home, file, where=f"{path}, frame {i}")
    photographs, absent, defects = _photographs(path, data, list(zip(names, files, strict=True)),
                                                masks=masks, findings=findings)  # fmt: skip
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


def _photographs(
    path: Path,
    data: dict[str, Any],
    files: list[tuple[str, Path]],
    *,
    masks: Path | None,
    findings: list[Finding],
) -> tuple[list[Photograph], list[str], list[float]]:
    """Photographs of the frames on disk, names of the others, and defects of the rotations.

    ``files`` holds each frame's name and picture; ``findings`` is added to.
    """
    lenses: dict[LensParameters, tuple[Undistortion, ...]] = {}
    photographs, absent, defects, unmasked = list[Photograph](), [], [], 0
    for i, (frame, (name, file)) in enumerate(zip(data["frames"], files, strict=True)):
        what = f"{path}, frame {i} ({name})"
        if not os.path.isfile(file):
            absent.append(name)
            continue
        keys = frame_keys(frame, data, what=what)
        cam_from_world, defect = _pose(keys, what)
        defects.append(defect)
        views = _views(keys, file, lenses, what=what)
        mask = _beside(path.parent, keys.mask_path, what)
        depth = _beside(path.parent, keys.depth_file_path, what)
        lost = [item.name for item in (mask, depth) if item and not os.path.isfile(item)]
        if lost:
            findings.append(Finding("warning", f"{what}: {', '.join(lost)} is absent on disk"))
        if mask is None and masks is not None:
            mask = masks / f"{name}.png"
            unmasked += not os.path.isfile(mask)
        photographs += [
            Photograph(
                lens.name(name),
                file,
                lens,
                lens.pose(cam_from_world),
                mask if mask and os.path.isfile(mask) else None,
                depth if depth and os.path.isfile(depth) else None,
                partial(read_depth, unit=keys.depth_unit_scale_factor),
            )
            for lens in views
        ]
    findings += mask_findings(unmasked, masks)
    return photographs, absent, defects


def read_transforms_cameras(path: Path) -> Cameras:
    """The cameras of a ``transforms.json`` alone, as a path has them: no picture has to be there.

    Distorted cameras become the pinhole cameras that ``read_transforms`` gives them.

    Returns:
        One camera a perspective view of a frame, in the order of names that ``read_transforms``
        has.
    """
    data = load_frames(path)
    frames = data["frames"]
    files = [_picture(path.parent, frame, f"{path}, frame {i}") for i, frame in enumerate(frames)]
    names = _names(files)
    lenses: dict[LensParameters, tuple[Undistortion, ...]] = {}
    found = []
    for i, frame in enumerate(frames):
        what = f"{path}, frame {i} ({names[i]})"
        keys = frame_keys(frame, data, what=what)
        pose = _pose(keys, what)[0]
        for lens in _views(keys, files[i], lenses, what=what):
            found.append((lens.name(names[i]), lens.K, lens.pose(pose), *lens.size))
    found.sort(key=lambda camera: natural_key(camera[0]))
    seen, K, poses, width, height = zip(*found, strict=True)
    return Cameras(np.array(K), np.array(poses), np.array(width), np.array(height), seen)


def write_transforms(
    path: Path,
    cameras: Cameras,
    *,
    image_paths: Sequence[str | Path],
    generated: Collection[str] = (),
) -> None:
    """Write cameras as a ``transforms.json`` that nerfstudio, instant-ngp and this project read.

    Args:
        cameras: V cameras; K without skew.
        image_paths: V pictures, absolute or relative to the file's folder.
        generated: names of the cameras whose pictures a completer made.
    """
    frames = []
    for i, image in enumerate(image_paths):
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
        if cameras.names[i] in generated:
            frame["generated"] = True
        frames.append(frame)
    data = {"exported_by": EXPORTER, "camera_model": "PINHOLE", "frames": frames}
    write_text(path, json.dumps(data, indent=2))


def written_here(path: Path) -> bool:
    """Whether ``write_transforms`` wrote a file that is there."""
    try:
        data = read_json(path)
        return bool(data.get("exported_by") == EXPORTER)
    except (OSError, ValueError, AttributeError, RecursionError):
        return False


def _relative(file: str | Path, folder: Path) -> str:
    if not Path(file).is_absolute():
        return Path(file).as_posix()
    return Path(os.path.relpath(file, folder.resolve())).as_posix()


def load_frames(path: Path) -> dict[str, Any]:
    """The content of a ``transforms.json``, with at least one frame."""
    try:
        data = read_json(path)
    except FileNotFoundError:
        raise ProjectError(f"{path}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
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
    if not file.name:
        raise ProjectError(f"{what}: file_path is {name!r}; expected the picture's path")
    # Unlike Path.is_file, this takes names that no file can have for absent ones.
    if os.path.isfile(file) or file.suffix.lower() in GUESSED_SUFFIXES:
        return file
    guesses = [file.with_name(file.name + suffix) for suffix in GUESSED_SUFFIXES]
    return next((guess for guess in guesses if os.path.isfile(guess)), guesses[0])


def _names(files: Sequence[Path]) -> list[str]:
    """The views' names: the pictures' paths below the deepest folder that they share."""
    # Absolute, as a file may name some pictures by absolute paths and others by relative ones.
    whole = [Path(os.path.abspath(file)) for file in files]
    shared = Path(os.path.commonpath([file.parent for file in whole]))
    return [file.relative_to(shared).as_posix() for file in whole]


def _pose(keys: FrameKeys, what: str) -> tuple[np.ndarray, float]:
    """(4, 4) cam_from_world with OpenCV axes, and how far the rotation was off."""
    pose, defect = rigid_transform(_matrix(keys.transform_matrix, what), what=what)
    return invert_rigid(pose @ OPENCV_FROM_OPENGL), defect


def _views(
    keys: FrameKeys,
    file: Path,
    lenses: dict[LensParameters, tuple[Undistortion, ...]],
    *,
    what: str,
) -> tuple[Undistortion, ...]:
    """A frame's perspective views, the same for all frames of its lens; ``lenses`` is added to."""
    params = keys.lens(file, what=what)
    if params not in lenses:
        lenses[params] = perspective_views(params.model, params.values, params.size, what=what)
    return lenses[params]


def _matrix(value: Any, what: str) -> np.ndarray:
    if value is None:
        raise ProjectError(f"{what}: no transform_matrix; expected a 4x4 pose")
    try:
        return np.array(value, np.float64)
    except (OverflowError, TypeError, ValueError):
        raise ProjectError(f"{what}: transform_matrix is no matrix; expected 4x4 numbers") from None


def _beside(folder: Path, name: str | None, what: str) -> Path | None:
    """The file that a frame names, on disk or not; None when it names none."""
    return named_file(folder, name, where=what) if name else None


class FrameKeys(BaseModel):
    """What is read of a frame. None stands for an absent key; a key whose value is null is wrong.

    Keys as nerfstudio and instant-ngp have them.
    """

    transform_matrix: Any = None
    mask_path: str | None = None
    depth_file_path: str | None = None
    depth_unit_scale_factor: Positive = 1e-3
    camera_model: str = ""
    is_fisheye: Annotated[int, Field(ge=0, le=1)] | None = None
    w: Pixels = None  # type: ignore[assignment]
    h: Pixels = None  # type: ignore[assignment]
    fl_x: Positive = None  # type: ignore[assignment]
    fl_y: Positive = None  # type: ignore[assignment]
    camera_angle_x: Angle = None  # type: ignore[assignment]
    cx: Number = None  # type: ignore[assignment]
    cy: Number = None  # type: ignore[assignment]
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0

    def lens(self, picture: Path, *, what: str) -> LensParameters:
        """The recorded camera.

        Args:
            picture: tells the size where no key does.
            what: where the keys were read, for messages.
        """
        if self.w is None or self.h is None:
            header = read_header(picture)
            size = header.width, header.height
        else:
            size = int(self.w), int(self.h)
        center = (
            size[0] / 2 if self.cx is None else self.cx,
            size[1] / 2 if self.cy is None else self.cy,
        )
        if self.camera_model == PANORAMA:
            return LensParameters(PANORAMA, (float(size[0]), float(size[1])), size)
        shared: tuple[float, ...] = (*self._focal(size[0], what), *center)
        named = self.camera_model
        if named in FISHEYE or (not named and self.is_fisheye):
            return LensParameters(
                "OPENCV_FISHEYE", (*shared, self.k1, self.k2, self.k3, self.k4), size
            )
        if named not in PERSPECTIVE:
            raise ProjectError(
                f"{what}: the camera model {named} is not read; expected one of "
                f"{', '.join(name for name in (*PERSPECTIVE, *FISHEYE, PANORAMA) if name)}; "
                "render perspective views first"
            )
        if self.k4:
            raise ProjectError(
                f"{what}: k4 = {self.k4} of a perspective camera; expected k1, k2, k3, p1, p2 at "
                "most (tools disagree on what a fourth one means); set camera_model to "
                "OPENCV_FISHEYE if it is one, or calibrate without k4"
            )
        shared = (*shared, self.k1, self.k2, self.p1, self.p2)
        if self.k3:
            return LensParameters("FULL_OPENCV", (*shared, self.k3, 0.0, 0.0, 0.0), size)
        return LensParameters("OPENCV", shared, size)

    def _focal(self, width: int, what: str) -> tuple[float, float]:
        x = self.fl_y if self.fl_x is None else self.fl_x
        if x is not None:
            return x, x if self.fl_y is None else self.fl_y
        if self.camera_angle_x is None:
            raise ProjectError(f"{what}: neither fl_x nor camera_angle_x; expected one of them")
        x = 0.5 * width / math.tan(0.5 * self.camera_angle_x)
        return x, x


def frame_keys(frame: Mapping[str, Any], shared: Mapping[str, Any], *, what: str) -> FrameKeys:
    """A frame's keys, checked.

    Args:
        shared: the file's, of which those of the camera stand in for absent ones of the frame.
        what: where they were read, for the message.
    """
    values = {key: shared[key] for key in shared if key not in OF_A_FRAME} | dict(frame)
    if "fl_x" in values or "fl_y" in values:
        values.pop("camera_angle_x", None)  # not looked at
    try:
        return FrameKeys.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise ProjectError(
            f"{what}: {first['loc'][0]} is {reprlib.repr(first['input'])}; expected "
            f"{first['msg'].removeprefix('Input should be ')}; mend it or export the file again"
        ) from None
