"""LLFF: ``SCENE/poses_bounds.npy`` with ``images`` and its copies ``images_4``, ``images_8``.

Each row holds a 3x5 matrix, the first three columns of which are the camera's axes "down, right,
backwards" in the world, then its centre, then height, width and focal length in pixels of
``images``; and the nearest and farthest depth. The principal point is the picture's middle. Rows
follow the pictures in the order of their names, so that a row's picture is known only where a
folder is complete, where ``sparse/0`` names the pictures, or where copies are numbered.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.colmap_files import find_model
from gvtools.scenes.colmap_model import load_model
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.picture_folders import (
    chosen_folder,
    picture_folders,
    pictures_by_stem,
    variants_of,
)
from gvtools.scenes.data_sets.posed_pictures import (
    Float64,
    PosedPicture,
    natural,
    pinhole_lens,
    posed_scene,
)
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.scene import Scene
from gvtools.untrusted import load_array

POSES = "poses_bounds.npy"
# Columns "right, down, forward" of the columns "down, right, backwards".
RIGHT_DOWN_FORWARD = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


def _scenes(root: Path) -> tuple[str, ...]:
    folders = [path.parent for path in root.glob(f"*/{POSES}")]
    return natural(folder.name for folder in folders if picture_folders(folder))


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder, home = chosen_folder(root, scene)
    rows = _rows(folder / POSES)
    files = _files(folder, home, len(rows))
    pictures = [_picture(row, file) for row, file in zip(rows, files, strict=True)]
    return posed_scene(folder, pictures, poses="world_from_cam", metric=False)


def _rows(path: Path) -> Float64:
    """(N, 3, 5) float64 of a file of poses and bounds."""
    try:
        rows = load_array(path).astype(np.float64)
    except (OSError, ValueError, TypeError) as error:
        raise ProjectError(f"{path}: {error}; expected an array of N x 17 numbers") from None
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise ProjectError(f"{path}: shape {rows.shape}; expected N x 17")
    rows = rows[:, :15].reshape(-1, 3, 5)
    if not np.isfinite(rows[..., 4]).all():
        raise ProjectError(f"{path}: a picture's size or focal length is not finite; copy it again")
    return rows


def _picture(row: Float64, file: Path) -> PosedPicture:
    height, width, focal = (float(value) for value in row[:, 4])
    pose = np.concatenate([row[:, :3] @ RIGHT_DOWN_FORWARD, row[:, 3:4]], axis=1)
    lens = pinhole_lens([focal, focal, width / 2, height / 2], (round(width), round(height)))
    return PosedPicture(file.name, file, lens, pose)


def _files(folder: Path, home: Path, count: int) -> list[Path]:
    """For each row the picture in the folder ``home``, on disk or not."""
    found = pictures_by_stem(home)
    ordered = sorted(found)
    if len(found) == count:
        return [found[stem] for stem in ordered]
    model = find_model(folder)
    if model is not None:
        names = sorted(image.name for image in load_model(model).images)
        if len(names) == count and any(Path(name).stem in found for name in names):
            return [found.get(Path(name).stem, home / name) for name in names]
    numbers = [re.fullmatch(r"image(\d{3})", stem) for stem in ordered]
    if found and all(numbers):
        return [found.get(f"image{i:03d}", home / f"image{i:03d}.png") for i in range(count)]
    raise ProjectError(
        f"{home}: {len(found)} pictures for {count} poses, which follow the pictures' order; "
        "complete the folder, or the scene's sparse/0, which names them"
    )


def _variants(root: Path) -> tuple[str, ...]:
    return variants_of(root, _scenes(root))


LAYOUT = Layout(f"SCENE/{POSES} with SCENE/images or images_N", _scenes, _read, _variants)
