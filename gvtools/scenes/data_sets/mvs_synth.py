"""MVS-Synth as published: ``GTAV_720/0000`` with ``images``, ``depths`` and ``poses``.

Files are ``images/0000.png``, ``depths/0000.exr`` and ``poses/0000.json``. Depth is the channel Y
of an OpenEXR file, z-depth, infinity for the sky. A pose file holds ``extrinsic``, 4x4
cam_from_world with OpenCV axes in the camera, and ``f_x, f_y, c_x, c_y`` in pixels. The world is
left-handed, so that the matrix has the determinant -1; here the world's y axis is turned round. The
unit is the game's and is not published, so the scene is not taken to be metric.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.array_files import exr_channel
from gvtools.scenes.data_sets.drawn import (
    NO_LENS,
    drawn_lens,
    folders_with,
    numbers_in,
    picture_size,
)
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import PosedPicture, posed_scene
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.scene import Finding, Scene
from gvtools.untrusted import read_json

Float64 = NDArray[np.float64]

IMAGE, DEPTH, POSE = "{:04d}.png", "{:04d}.exr", "{:04d}.json"
# From a right-handed world to the left-handed one of the files, and back.
MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0])


def exr_depth(path: Path, *, channels: tuple[str, ...] = ("Y", "R")) -> NDArray[np.float32]:
    """(H, W) float32 depth of an OpenEXR file, 0 where it says infinity, NaN or 0 and less."""
    depth = exr_channel(path, channels)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _scenes(root: Path) -> tuple[str, ...]:
    return folders_with(root, [f"{a}*/{held}" for a in ("", "*/") for held in ("images", "poses")])


def _camera(path: Path) -> tuple[Float64, tuple[float, ...]]:
    """cam_from_world and fx, fy, cx, cy of a pose file."""
    try:
        values = read_json(path)
        pose = np.array(values["extrinsic"], np.float64).reshape(4, 4)
        lens = tuple(float(values[key]) for key in ("f_x", "f_y", "c_x", "c_y"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ProjectError(
            f"{path}: {type(error).__name__} ({error}); expected extrinsic, f_x, f_y, c_x and c_y"
        ) from None
    return (pose @ MIRRORED if np.linalg.det(pose[:3, :3]) < 0 else pose), lens


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    posed = numbers_in(folder / "poses", POSE)
    frames = sorted(numbers_in(folder / "images", IMAGE).union(posed))
    size = picture_size(folder / "images" / IMAGE.format(i) for i in frames)
    pictures, damaged = [], []
    for i in frames:
        pose, lens = None, NO_LENS
        if i in posed:
            try:
                pose, values = _camera(folder / "poses" / POSE.format(i))
                lens = drawn_lens(values, size)
            except ProjectError as error:
                damaged.append(Finding("warning", str(error)))
        name = IMAGE.format(i)
        depth = folder / "depths" / DEPTH.format(i)
        pictures.append(PosedPicture(name, folder / "images" / name, lens, pose, depth, exr_depth))
    return posed_scene(folder, pictures, poses="cam_from_world", metric=False, findings=damaged[:1])


LAYOUT = Layout("NNNN or GTAV_NNN/NNNN with images, depths and poses", _scenes, _read)
