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
from gvtools.scenes.calibration import OPENCV_FROM_OPENGL, Float64, finite_array, opencv_pose
from gvtools.scenes.faces import PANORAMA, perspective_views
from gvtools.scenes.images import read_depth, read_header
from gvtools.scenes.matching import given_folder
from gvtools.scenes.photographs import PosedFrame, posed_scene
from gvtools.scenes.scene import Scene, natural_key
from gvtools.scenes.undistort import LensParameters, Undistortion
from gvtools.untrusted import is_file, named_file, read_json, reading

FILE = "transforms.json"
EXPORTER = "gvtools"  # the value of ``exported_by`` in files written here
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
    files = _pictures(path, data["frames"])
    names = _names(files)
    masks = None if masks is None else given_folder(masks, "masks")
    home = path.parent
    if images is not None:
        home = given_folder(images, "images")
        files = [home / name for name in names]
    cameras: dict[LensParameters, tuple[Undistortion, ...]] = {}
    frames = []
    for i, (entry, name, file) in enumerate(zip(data["frames"], names, files, strict=True)):
        named_file(home, file, where=f"{path}, frame {i}")
        if not is_file(file):
            frames.append(PosedFrame(name, file, None, None))
            continue
        what = f"{path}, frame {i} ({name})"
        keys = frame_keys(entry, data, what=what)
        mask = None if masks is None else masks / f"{name}.png"
        if keys.mask_path:
            mask = named_file(path.parent, keys.mask_path, where=what)
        depth = keys.depth_file_path
        frames.append(
            PosedFrame(
                name,
                file,
                _views(keys, file, cameras, what=what),
                _pose(keys, what),
                named_file(path.parent, depth, where=what) if depth else None,
                partial(read_depth, unit=keys.depth_unit_scale_factor),
                mask,
                where=what,
            )
        )
    return posed_scene(
        path.parent,
        frames,
        poses="world_from_cam",
        metric=False,
        kind="transforms",
        strict=True,
        advice="give their folder with --images",
    )


def transforms_frames(
    path: Path, home: Path, *, lists: tuple[str, ...] = ("frames",)
) -> list[PosedFrame]:
    """Frames of a data set's ``transforms.json`` whose pictures lie in ``home``, world_from_cam.

    ``lists`` name the lists of frames that are read.
    """
    data = load_frames(path)
    frames = []
    for key in lists:
        entries = data.get(key) or []
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ProjectError(f"{path}: {key} is no list of frames; download it again")
        for i, entry in enumerate(entries):
            what = f"{path}, {key} {i}"
            picture = home / _file_path(entry, what).rpartition("/")[2]
            keys = frame_keys(entry, data, what=what)
            pose = finite_array(keys.transform_matrix, 4, 4)
            pose = None if pose is None else opencv_pose(pose)
            lens = keys.lens(picture, what=what)
            frames.append(PosedFrame(picture.name, picture, lens, pose, where=what))
    return frames


def read_transforms_cameras(path: Path) -> Cameras:
    """The cameras of a ``transforms.json`` alone, as a path has them: no picture has to be there.

    Views and their order are those of ``read_transforms``.
    """
    data = load_frames(path)
    files = _pictures(path, data["frames"])
    cameras: dict[LensParameters, tuple[Undistortion, ...]] = {}
    found = []
    for i, (entry, name, file) in enumerate(zip(data["frames"], _names(files), files, strict=True)):
        what = f"{path}, frame {i} ({name})"
        keys = frame_keys(entry, data, what=what)
        pose = invert_rigid(rigid_transform(_pose(keys, what), what=what)[0])
        for lens in _views(keys, file, cameras, what=what):
            found.append((lens.name(name), lens.K, lens.pose(pose), *lens.size))
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
    with reading(path, "expected a transforms.json"):
        data = read_json(path)
        frames = data.get("frames") if isinstance(data, dict) else None
        if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise ValueError("no list 'frames'")
        if not frames:
            raise ValueError("no frames")
        return data


def _file_path(frame: Mapping[str, Any], what: str) -> str:
    name = frame.get("file_path")
    if not isinstance(name, str) or not os.path.basename(os.path.normpath(name)).strip("./"):
        raise ProjectError(f"{what}: file_path is {name!r}; expected the picture's path")
    return name.replace("\\", "/")


def _pictures(path: Path, frames: Sequence[Mapping[str, Any]]) -> list[Path]:
    """The pictures that frames name, on disk or not."""
    files = []
    for i, frame in enumerate(frames):
        file = Path(os.path.normpath(path.parent / _file_path(frame, f"{path}, frame {i}")))
        if not is_file(file) and file.suffix.lower() not in GUESSED_SUFFIXES:
            guesses = [file.with_name(file.name + suffix) for suffix in GUESSED_SUFFIXES]
            file = next((guess for guess in guesses if is_file(guess)), guesses[0])
        files.append(file)
    return files


def _names(files: Sequence[Path]) -> list[str]:
    """The views' names: the pictures' paths below the deepest folder that they share."""
    # Absolute, as a file may name some pictures by absolute paths and others by relative ones.
    whole = [Path(os.path.abspath(file)) for file in files]
    shared = Path(os.path.commonpath([file.parent for file in whole]))
    return [file.relative_to(shared).as_posix() for file in whole]


def _pose(keys: FrameKeys, what: str) -> Float64:
    """world_from_cam with OpenCV axes, of any shape and as the file has it otherwise."""
    if keys.transform_matrix is None:
        raise ProjectError(f"{what}: no transform_matrix; expected a 4x4 pose")
    try:
        pose = np.array(keys.transform_matrix, np.float64)
    except (OverflowError, TypeError, ValueError):
        raise ProjectError(f"{what}: transform_matrix is no matrix; expected 4x4 numbers") from None
    return pose * np.diag(OPENCV_FROM_OPENGL) if pose.shape[-1:] == (4,) else pose


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
        """The recorded camera; the ``picture`` tells the size where no key does."""
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
    """A frame's keys, checked; those of the camera may stand in the file's ``shared`` ones."""
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
