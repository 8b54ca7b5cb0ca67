"""GTA-SfM as published: one HDF5 file a sequence, with ``image_0, depth_0, pose_0, K_0`` and so on.

Images are encoded files (JPEG or PNG) as bytes; depth is float z-depth; poses are 4x4
world_from_cam with OpenCV axes; K is 3x3 with its principal point at (W / 2, H / 2). The unit is
the game's and is not published.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.array_files import hdf5_array, hdf5_file, read_dataset
from gvtools.scenes.data_sets.drawn import NO_LENS, drawn_lens
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import PosedPicture, natural, posed_scene
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import UNREADABLE
from gvtools.scenes.scene import Frame, Scene
from gvtools.untrusted import open_picture

SUFFIX = ".hdf5"
KEY = re.compile(r"(image|depth|pose|K)_([0-9]+)")


def hdf5_picture(path: Path, *, key: str) -> Frame:
    """The picture that an HDF5 file holds as the bytes of a JPEG or PNG."""
    data = np.asarray(hdf5_array(path, key), np.uint8).tobytes()
    try:
        with open_picture(data) as image:
            return Frame(np.array(image.convert("RGB")))
    except UNREADABLE as error:
        raise ProjectError(f"{path}, {key}: no picture ({error}); download it again") from None


def hdf5_depth(path: Path, *, key: str) -> NDArray[np.float32]:
    """(H, W) float32 z-depth that an HDF5 file holds, 0 where it is not finite and positive."""
    depth = np.squeeze(hdf5_array(path, key)).astype(np.float32)
    if depth.ndim != 2:
        raise ProjectError(f"{path}, {key}: shape {depth.shape}; expected (height, width)")
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _scenes(root: Path) -> tuple[str, ...]:
    files = (file for pattern in ("", "*/") for file in root.glob(f"{pattern}*{SUFFIX}"))
    return natural(file.relative_to(root).with_suffix("").as_posix() for file in files)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    path = root / f"{scene}{SUFFIX}"
    pictures = []
    with hdf5_file(path) as file:
        matches = [match for match in map(KEY.fullmatch, file) if match]
        present = {match[0] for match in matches}
        frames = sorted({int(match[2]) for match in matches})
        size = _size(
            read_dataset(path, file[f"image_{i}"]) for i in frames if f"image_{i}" in present
        )
        for i in frames:
            image, depth, pose, K = (f"{part}_{i}" for part in ("image", "depth", "pose", "K"))
            posed = pose in present and K in present
            pictures.append(
                PosedPicture(
                    image,
                    # A path that is not there says that the picture is not.
                    path if image in present else path / image,
                    drawn_lens(read_dataset(path, file[K])[[0, 1, 0, 1], [0, 1, 2, 2]], size)
                    if posed
                    else NO_LENS,
                    np.asarray(read_dataset(path, file[pose]), np.float64) if posed else None,
                    path if depth in present else path / depth,
                    partial(hdf5_depth, key=depth),
                    read=partial(hdf5_picture, key=image),
                )
            )
    return posed_scene(path, pictures, poses="world_from_cam", metric=False)


def _size(pictures: Iterable[NDArray[np.uint8]]) -> tuple[int, int]:
    """Width and height of the first encoded picture with a sound header, pixels; else 1 x 1."""
    for data in pictures:
        try:
            with open_picture(np.asarray(data, np.uint8).tobytes()) as image:
                return image.size
        except UNREADABLE:
            continue
    return 1, 1


LAYOUT = Layout(f"SEQUENCE{SUFFIX}, also below train and test", _scenes, _read)
