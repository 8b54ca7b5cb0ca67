"""Frames of a nerfstudio ``transforms.json`` whose pictures lie elsewhere than it says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.posed_pictures import OPENCV_FROM_OPENGL, Float64, PosedPicture
from gvtools.scenes.transforms_frame import frame_keys
from gvtools.scenes.transforms_json import load_frames


def nerfstudio_pictures(
    file: Path, picture_of: Callable[[str], Path], *, keys: tuple[str, ...] = ("frames",)
) -> list[PosedPicture]:
    """The file's frames with poses world_from_cam in the file's world, OpenCV axes.

    Args:
        file: the ``transforms.json``.
        picture_of: where the picture of a frame's ``file_path`` should be.
        keys: which lists of frames are read.
    """
    data = load_frames(file)
    pictures = []
    for key in keys:
        listed = data.get(key) or []
        if not isinstance(listed, list) or not all(isinstance(frame, dict) for frame in listed):
            raise ProjectError(f"{file}: {key} is no list of frames; download it again")
        for i, frame in enumerate(listed):
            what = f"{file}, {key} {i}"
            named = frame.get("file_path")
            if not isinstance(named, str) or not named:
                raise ProjectError(f"{what}: no file_path; expected the picture's path")
            path = picture_of(named)
            values = frame_keys(frame, data, what=what)
            pose = _matrix(values.transform_matrix)
            pictures.append(PosedPicture(path.name, path, values.lens(path, what=what), pose))
    return pictures


def _matrix(value: object) -> Float64 | None:
    """(4, 4) world_from_cam with OpenCV axes; None where there is no such matrix."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        return None
    return matrix @ OPENCV_FROM_OPENGL if matrix.shape == (4, 4) else None
