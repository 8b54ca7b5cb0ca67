"""``transforms.json`` of nerfstudio and instant-ngp, read and written; Blender's splits are read.

The file's cameras have OpenGL axes (y up, z backward) and poses camera-to-world; its principal
point counts the first pixel's centre as (0.5, 0.5), as this project does.
"""

from __future__ import annotations

import json
import math
import os
import re
import reprlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError

from gvtools.cameras import Cameras, invert_rigid, rigid_transform
from gvtools.errors import ProjectError
from gvtools.files import write_text
from gvtools.scenes.calibration import (
    MILLIMETRES,
    OPENCV_FROM_OPENGL,
    Float64,
    finite_array,
    found_pose,
    scaled_lens,
    times_as_large,
)
from gvtools.scenes.images import read_depth, read_header
from gvtools.scenes.layout import holds_views
from gvtools.scenes.matching import find_renamed, given_folder, named
from gvtools.scenes.photographs import PosedFrame, posed_scene
from gvtools.scenes.scene import Finding, Scene, natural_key
from gvtools.scenes.selection import select
from gvtools.scenes.undistort import PANORAMA, LensParameters, Undistortion, perspective_views
from gvtools.trajectory_files import read_trajectory
from gvtools.untrusted import expect, is_file, read_json, reading

FILE = "transforms.json"
# The files of Blender's synthetic scenes, one a split; a picture of several belongs to the first.
SPLITS = {name: f"transforms_{name}.json" for name in ("train", "test", "val")}
EXPORTER = "gvtools"  # the value of ``exported_by`` in files written here
GUESSED_SUFFIXES = (".png", ".jpg", ".jpeg")  # Blender's files name pictures without a suffix

# nerfstudio's names; the fisheye ones share one model, the others the polynomial one.
PERSPECTIVE = ("", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
UNBENT = PERSPECTIVE[1:3]
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

# Keys that each frame has for itself.
OF_A_FRAME = ("transform_matrix", "mask_path", "depth_file_path", "depth_path")
# What tells the focal length along an axis: pixels, or a field of view in radians or degrees.
FOCAL = {axis: (f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov") for axis in "xy"}
LENS = ("fl_x", "fl_y", "cx", "cy")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# Of models that are not read.
FURTHER = ("k5", "k6", "p3", "p4", "b1", "b2")
# What tells one axis may differ so much from what else tells it.
SAME_FOCAL = 0.02

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
Pixels = Annotated[Number, Field(ge=1, le=200_000, multiple_of=1)]
Angle = Annotated[Number, Field(gt=0, lt=math.pi)]
Degrees = Annotated[Number, Field(gt=0, lt=180)]


class _Listed(NamedTuple):
    """A frame of a file: the file's keys and its own, and the picture that it names."""

    shared: Mapping[str, Any]
    entry: Mapping[str, Any]
    file: Path  # on disk or not
    name: str  # the view's
    what: str  # where it stands, for messages


def read_transforms(path: Path, *, images: Path | None = None, masks: Path | None = None) -> Scene:
    """The project of a ``transforms.json``.

    Intrinsics may be shared or stand in each frame, as ``fl_x`` or as fields of view.
    Distorted cameras become pinhole cameras, panoramas and wide fisheyes several (``undistort``);
    depth (``depth_file_path``, times ``depth_unit_scale_factor``, 1e-3 when absent; ``depth_path``,
    times ``integer_depth_scale``) and masks (``mask_path``, black = ignore) go through the same
    mapping. Views are named by their path below the deepest folder they share; those of splits
    begin with ``train/``, ``test/`` or ``val/``.
    ``masks`` is a folder with ``NAME.png`` for the view NAME, where frames name no mask, ``images``
    one to take the pictures from instead, by their path below the shared folder.
    """
    listed, findings = _listed(Path(path))
    root = Path(path) if Path(path).is_dir() else Path(path).parent
    masks = None if masks is None else given_folder(masks, "masks")
    home = root if images is None else given_folder(images, "images")
    frames, said = [], dict[str, list[str]]()
    named_files = [item.file if images is None else home / item.name for item in listed]
    files, renamed = find_renamed(home, named_files, where=[item.what for item in listed])
    for file, (shared, entry, _, name, where) in zip(files, listed, strict=True):
        if not is_file(file):
            frames.append(PosedFrame(name, file, None, None))
            continue
        what = f"{where} ({name})"
        keys = frame_keys(entry, shared, what=what)
        mask = None if masks is None else masks / f"{name}.png"
        if keys.mask_path:
            mask = root / keys.mask_path
        depth, unit = keys.depth()
        lens, pose = keys.lens(file, what=what), _pose(keys, what)
        reader, there = partial(read_depth, unit=unit), root / depth if depth else None
        frames.append(PosedFrame(name, file, lens, pose, there, reader, mask, where=what))
        lines = [*keys.doubts(file), *_unread(entry, root)]
        if mask is None and is_file(file.with_name(f"dynamic_mask_{file.stem}.png")):
            lines.append(
                "dynamic_mask_NAME.png lies beside them, whose white instant-ngp ignores, and is "
                "not read; turn black and white over and give the folder of NAME.png with --masks"
            )
        for line in lines:
            said.setdefault(line, []).append(name)
    findings += renamed
    for noun, key, folder in (("masks", "mask", masks or root), ("depth maps", "depth", root)):
        rows = [i for i, frame in enumerate(frames) if getattr(frame, key) is not None]
        places = [frames[i].where for i in rows]
        others, met = find_renamed(
            folder, [getattr(frames[i], key) for i in rows], where=places, noun=noun, also=root
        )
        for i, other in zip(rows, others, strict=True):
            changed: dict[str, Any] = {key: other}
            frames[i] = replace(frames[i], **changed)
        findings += met
    findings += [
        Finding("warning", f"{len(names)} frames ({named(names)}): {line}")
        for line, names in said.items()
    ]
    return posed_scene(
        root,
        frames,
        poses="world_from_cam",
        metric=False,
        kind="transforms",
        strict=True,
        findings=findings,
        advice="give their folder with --images",
    )


def _unread(entry: Mapping[str, Any], root: Path) -> list[str]:
    """A line for each depth map or mask of a frame whose key is none that is read."""
    others = {key: value for key, value in entry.items() if key not in FrameKeys.model_fields}
    return [
        f"{key} names files that are not read; depth maps are named by depth_file_path, masks by "
        "mask_path (black = ignore)"
        for key, value in others.items()
        if re.search("depth|mask", key) and isinstance(value, str) and is_file(root / value)
    ]


def is_transforms(folder: Path) -> bool:
    """Whether a folder holds a ``transforms.json``, or those of splits."""
    return any((folder / name).is_file() for name in (FILE, *SPLITS.values()))


def _listed(path: Path) -> tuple[list[_Listed], list[Finding]]:
    """The frames of a file or folder, each picture once, and what is to be said of them."""
    single = path.is_file() or (path / FILE).is_file() or not is_transforms(path)
    if single:
        parts = {"": path / FILE if path.is_dir() else path}
    else:
        splits = ((split, path / name) for split, name in SPLITS.items())
        parts = {split: file for split, file in splits if file.is_file()}
    owner, found, findings = dict[Path, str](), list[_Listed](), list[Finding]()
    for split, path in parts.items():
        data = load_frames(path)
        files, met = _pictures(path, data["frames"])
        findings += met
        for i, (entry, file) in enumerate(zip(data["frames"], files, strict=True)):
            if owner.setdefault(file, split) == split:
                found.append(_Listed(data, entry, file, split, f"{path}, frame {i}"))
    listed = [
        item._replace(name=name if name.startswith(f"{item.name}/") else f"{item.name}/{name}")
        if item.name
        else item._replace(name=name)
        for item, name in zip(found, _names([item.file for item in found]), strict=True)
    ]
    if single:
        cloud = data.get("ply_file_path")
        others = [name for name in SPLITS.values() if (path.parent / name).is_file()]
        lists = [key for key in data if key.endswith("_filenames") and data[key]]
        unused = {
            f"ply_file_path ({reprlib.repr(cloud)}) is not read: depth comes from pictures": cloud,
            f"{named(others)} beside {path.name}: not read; give its path to read it": others,
            f"{named(lists)}: not read; give such names by --context and --targets": lists,
        }
        return listed, findings + [Finding("info", line) for line, there in unused.items() if there]
    sizes = Counter(item.name for item in found)
    line = f"splits: {', '.join(f'{split} ({count} frames)' for split, count in sizes.items())}"
    if len(sizes) > 1:
        line += "; select them by name: --context {} --targets {}".format(*sizes)
    return listed, [*findings, Finding("info", line)]


def transforms_frames(
    path: Path, home: Path, *, lists: tuple[str, ...] = ("frames",)
) -> list[PosedFrame]:
    """Frames of a ``transforms.json``, by its ``lists``, whose pictures lie in ``home``."""
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
            pose = found_pose(keys.transform_matrix, 4, 4)
            lens = keys.lens(picture, what=what)
            frames.append(PosedFrame(picture.name, picture, lens, pose, where=what))
    return frames


def read_camera_path(
    path: Path, captured: Cameras | None, *, selection: str = "all"
) -> Cameras | None:
    """Cameras of a file without pictures, of which some are selected; None for a project.

    That is a trajectory, which takes size and intrinsics from the first of the captured views, or a
    ``transforms.json`` of which no picture is there, as viewers save paths.
    """
    if captured is not None and not holds_views(path):
        cameras = read_trajectory(path, captured[0], beside=captured)
    elif path.is_file() and path.suffix.lower() == ".json":
        if any(item.file.is_file() for item in _listed(path)[0]):
            return None
        cameras = read_transforms_cameras(path)
    else:
        return None
    return cameras[list(map(cameras.names.index, select(cameras.names, selection)))]


def read_transforms_cameras(path: Path) -> Cameras:
    """The cameras of a ``transforms.json`` as ``read_transforms`` has them, without pictures."""
    cameras: dict[LensParameters, tuple[Undistortion, ...]] = {}
    found = []
    for shared, entry, file, name, where in _listed(Path(path))[0]:
        what = f"{where} ({name})"
        keys = frame_keys(entry, shared, what=what)
        pose = invert_rigid(rigid_transform(_pose(keys, what), what=what)[0])
        params = keys.lens(file, what=what)
        if params not in cameras:
            cameras[params] = perspective_views(*params, what=what)
        for lens in cameras[params]:
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
    up: NDArray[np.float64] | None = None,
) -> None:
    """Write cameras as a ``transforms.json`` that nerfstudio, instant-ngp and this project read.

    Pictures are absolute or relative to the file's folder; a completer made those of ``generated``
    cameras. ``up`` is a unit vector in the world.
    """
    frames = []
    for i, image in enumerate(image_paths):
        K, pose = cameras.K[i], cameras.world_from_cam[i] @ OPENCV_FROM_OPENGL
        frame: dict[str, Any] = {
            "file_path": _relative(image, path.parent),
            **dict(zip(LENS, K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)),
            "w": int(cameras.width[i]),
            "h": int(cameras.height[i]),
            "transform_matrix": pose.tolist(),
        }
        if cameras.names[i] in generated:
            frame["generated"] = True
        frames.append(frame)
    data = {"exported_by": EXPORTER, "camera_model": "PINHOLE", "frames": frames}
    data |= {} if up is None else {"up": up.tolist()}
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
        listed = isinstance(frames, list) and frames and all(isinstance(f, dict) for f in frames)
        expect(listed, "no list of frames")
        return data


def _file_path(frame: Mapping[str, Any], what: str) -> str:
    name = frame.get("file_path")
    if not isinstance(name, str) or not os.path.basename(os.path.normpath(name)).strip("./"):
        raise ProjectError(f"{what}: file_path is {name!r}; expected the picture's path")
    return name.replace("\\", "/")


def _pictures(path: Path, frames: Sequence[Mapping[str, Any]]) -> tuple[list[Path], list[Finding]]:
    """The pictures that frames name, on disk or not, or those of nearly the same name."""
    files = []
    for i, frame in enumerate(frames):
        file = Path(os.path.normpath(path.parent / _file_path(frame, f"{path}, frame {i}")))
        if not is_file(file) and file.suffix.lower() not in GUESSED_SUFFIXES:
            guesses = [file.with_name(file.name + suffix) for suffix in GUESSED_SUFFIXES]
            file = next((guess for guess in guesses if is_file(guess)), guesses[0])
        files.append(file)
    return find_renamed(path.parent, files)


def _names(files: Sequence[Path]) -> list[str]:
    """The views' names: the pictures' paths below the deepest folder that they share."""
    # Absolute, as a file may name some pictures by absolute paths and others by relative ones.
    whole = [Path(os.path.abspath(file)) for file in files]
    shared = Path(os.path.commonpath([file.parent for file in whole]))
    return [file.relative_to(shared).as_posix() for file in whole]


def _pose(keys: FrameKeys, what: str) -> Float64:
    """world_from_cam with OpenCV axes, of any shape and as the file has it otherwise."""
    with reading(what, "expected a transform_matrix of 4x4 numbers"):
        expect(keys.transform_matrix is not None, "no transform_matrix")
        pose = np.array(keys.transform_matrix, np.float64)
    pose = pose.reshape(4, 4) if pose.shape == (16,) else pose
    return pose * np.diag(OPENCV_FROM_OPENGL) if pose.shape[-1:] == (4,) else pose


class FrameKeys(BaseModel):
    """What is read of a frame, as nerfstudio has it; None is an absent key, null a wrong value."""

    model_config = ConfigDict(extra="allow")
    transform_matrix: Any = None
    mask_path: str | None = None
    depth_file_path: str | None = None
    depth_unit_scale_factor: Positive = MILLIMETRES
    depth_path: str | None = None
    integer_depth_scale: Positive | None = None
    camera_model: str = ""
    is_fisheye: Annotated[int, Field(ge=0, le=1)] | None = None
    w: Pixels = None  # type: ignore[assignment]
    h: Pixels = None  # type: ignore[assignment]
    fl_x: Positive = None  # type: ignore[assignment]
    fl_y: Positive = None  # type: ignore[assignment]
    camera_angle_x: Angle = None  # type: ignore[assignment]
    camera_angle_y: Angle = None  # type: ignore[assignment]
    x_fov: Degrees = None  # type: ignore[assignment]
    y_fov: Degrees = None  # type: ignore[assignment]
    cx: Number = None  # type: ignore[assignment]
    cy: Number = None  # type: ignore[assignment]
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    # nerfstudio's k1, k2, k3, k4, p1, p2 in one; they count before the single ones.
    distortion_params: Annotated[list[Number], Field(min_length=6, max_length=6)] | None = None
    # The file's, where the frame tells a focal length of its own.
    _of_file: FrameKeys | None = PrivateAttr(None)

    def lens(self, picture: Path, *, what: str) -> LensParameters:
        """The recorded camera; the ``picture`` tells the size where no key does."""
        if self.distortion_params is not None:
            told = dict(zip(DISTORTION, self.distortion_params, strict=True))
            other = self.model_copy(update={**told, "distortion_params": None})
            return other.lens(picture, what=what)
        size = self._size(picture)
        if (times := self._times(size)) != 1:
            whole = {"w": round(size[0] * times), "h": round(size[1] * times)}
            return scaled_lens(self.model_copy(update=whole).lens(picture, what=what), size)
        center = (
            size[0] / 2 if self.cx is None else self.cx,
            size[1] / 2 if self.cy is None else self.cy,
        )
        if self.camera_model == PANORAMA:
            return LensParameters(PANORAMA, (float(size[0]), float(size[1])), size)
        shared: tuple[float, ...] = (*self._focal(size, what), *center)
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
        others = {"k4": self.k4, **(self.model_extra or {})}
        for key, value in ((key, others[key]) for key in ("k4", *FURTHER) if others.get(key)):
            raise ProjectError(
                f"{what}: {key} = {value} of a perspective camera; expected k1, k2, k3, p1, p2 at "
                "most (tools disagree on what others mean); set camera_model to OPENCV_FISHEYE if "
                "it is one, or undistort the pictures first"
            )
        shared = (*shared, self.k1, self.k2, self.p1, self.p2)
        if self.k3:
            return LensParameters("FULL_OPENCV", (*shared, self.k3, 0.0, 0.0, 0.0), size)
        return LensParameters("OPENCV", shared, size)

    def depth(self) -> tuple[str | None, float]:
        """The depth map and scene units per stored unit; apps for phones name them otherwise."""
        if self.depth_file_path or not self.depth_path:
            return self.depth_file_path, self.depth_unit_scale_factor
        return self.depth_path, self.integer_depth_scale or self.depth_unit_scale_factor

    def doubts(self, picture: Path) -> list[str]:
        """What the keys leave open or contradict."""
        lines = []
        if self.depth_path and not self.depth_file_path and self.integer_depth_scale is None:
            unit = self.depth_unit_scale_factor
            lines.append(f"depth_path without integer_depth_scale: {unit:g} a step is assumed")
        if self.depth_path and self.depth_file_path not in (None, self.depth_path):
            lines.append("depth_path and depth_file_path differ: the second is taken")
        bent = [key for key in DISTORTION if getattr(self, key)]
        if self.camera_model in UNBENT and bent:
            lines.append(f"camera_model {self.camera_model}, and yet {named(bent)}: these are used")
        size = self._size(picture)
        if (times := self._times(size)) != 1:
            lines.append(
                f"no w and h, and the principal point ({self.cx:g}, {self.cy:g}) is the middle of "
                f"pictures {times:.4g} times as large as these ({size[0]}x{size[1]}): intrinsics "
                "scaled; if they are of these pictures, write w and h"
            )
        for level in (self, self._of_file) if not self.is_fisheye else ():
            for axis, length in zip("xy", size, strict=True):
                told = {} if level is None else level._told(axis, length)
                (first, one), *others = told.items() or [("", 0.0)]
                lines += [
                    f"{key} says a focal length of {value:.5g} pixels, {first} {one:.5g}: "
                    f"{first} is taken; take the wrong one away"
                    for key, value in others
                    if abs(value - one) > SAME_FOCAL * one
                ]
        return lines

    def _size(self, picture: Path) -> tuple[int, int]:
        if self.w is not None and self.h is not None:
            return int(self.w), int(self.h)
        header = read_header(picture)
        return header.width, header.height

    def _times(self, size: tuple[int, int]) -> float:
        """How many times as large the pictures are that the principal point is the middle of."""
        sized = self.w is not None and self.h is not None
        if sized or self.cx is None or self.cy is None:
            return 1
        return times_as_large((self.cx, self.cy), size)

    def _told(self, axis: str, length: int) -> dict[str, float]:
        """Focal length along an axis by each key that tells it, the one that counts first."""
        pixels, radians, degrees = (getattr(self, key) for key in FOCAL[axis])
        angles = radians, None if degrees is None else math.radians(degrees)
        found = [pixels, *(a and 0.5 * length / math.tan(0.5 * a) for a in angles)]
        return {key: value for key, value in zip(FOCAL[axis], found, strict=True) if value}

    def _axes(self, size: tuple[int, int]) -> list[float | None]:
        told = self._told("x", size[0]), self._told("y", size[1])
        return [next(iter(values.values()), None) for values in told]

    def _focal(self, size: tuple[int, int], what: str) -> tuple[float, float]:
        x, y = self._axes(size)
        of_file = [None, None] if self._of_file is None else self._of_file._axes(size)
        if of_file[0] and of_file[1]:
            # Both files and pictures keep the shape of their pixels.
            shape = of_file[1] / of_file[0]
            x, y = x or (y and y / shape), y or (x and x * shape)
        x, y = x or of_file[0], y or of_file[1]
        x, y = x or y, y or x
        if not x or not y:
            raise ProjectError(
                f"{what}: no focal length; expected fl_x, camera_angle_x or x_fov, or those of y"
            )
        return x, y


def frame_keys(frame: Mapping[str, Any], shared: Mapping[str, Any], *, what: str) -> FrameKeys:
    """A frame's keys, checked; those of the camera may stand in the file's ``shared`` ones."""
    told = {key for keys in FOCAL.values() for key in keys}
    if {"fl_x", "fl_y"} & {*frame, *shared}:
        angles = told - {"fl_x", "fl_y"}
        frame, shared = (
            {key: value for key, value in level.items() if key not in angles or _angle(value)}
            for level in (frame, shared)
        )
    values = {key: shared[key] for key in shared if key not in OF_A_FRAME} | dict(frame)
    of_file = None
    if told & {*frame} and told & {*shared}:
        of_file = _checked({key: shared[key] for key in told & {*shared}}, what)
        values = {key: value for key, value in values.items() if key not in told - {*frame}}
    keys = _checked(values, what)
    keys._of_file = of_file
    return keys


def _angle(value: object) -> bool:
    found = finite_array(value, 1)
    return found is not None and 0 < found[0] < 180


def _checked(values: dict[str, Any], what: str) -> FrameKeys:
    try:
        return FrameKeys.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise ProjectError(
            f"{what}: {first['loc'][0]} is {reprlib.repr(first['input'])}; expected "
            f"{first['msg'].removeprefix('Input should be ')}; mend it or export the file again"
        ) from None
