"""The cameras of a film, from a path's name, a trajectory file or a project."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.trajectories import PATHS, named_path

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory

CAPTURED = "cameras"
FRAMES = 120
FORMS = (
    f"{', '.join(f'{name}:N' for name in PATHS)}, {CAPTURED} (the captured views in order), a "
    "trajectory file (TUM or KITTI), a transforms.json such as 'gvtools view' saves, or a project, "
    "the last two as PATH or PATH@SELECTION"
)


def film_cameras(memory: SpatialMemory, path: str, *, width: int | None = None) -> Cameras:
    """The cameras of a film's frames, all of one even size, as video coders need it.

    Args:
        memory: ``orbit`` and the like are computed from its observed views; the first of these
            gives intrinsics and size to paths that have none.
        path: one of FORMS.
        width: of the frames, pixels; None keeps the cameras' width.
    """
    captured = [view.camera for view in memory.views.photographed]
    if not captured:
        raise OptionError("a memory without observed views; give a run or its memory.npz")
    from gvtools.cameras import concatenate

    cameras = _cameras(memory, concatenate(captured), path)
    first = cameras[0]
    columns, rows = int(first.width[0]), int(first.height[0])
    if (cameras.width != columns).any() or (cameras.height != rows).any():
        # A film has one size: all frames take the first camera's intrinsics and size.
        count = len(cameras)
        cameras = Cameras(
            np.repeat(first.K, count, axis=0), cameras.cam_from_world,
            np.full(count, columns), np.full(count, rows), cameras.names,
        )  # fmt: skip
    if width is not None:
        if width < 16:
            raise OptionError(f"--width {width}; expected 16 or more")
        columns, rows = width, max(16, round(rows * width / columns))
        cameras = cameras.resized(columns, rows)
    return cameras.cropped(0, 0, width=columns // 2 * 2, height=rows // 2 * 2)


def _cameras(memory: SpatialMemory, captured: Cameras, path: str) -> Cameras:
    name, _, count = path.partition(":")
    if name in PATHS:
        if count and not (count.isdecimal() and int(count) >= 1):
            raise OptionError(f"--path {path!r}; expected {name}:N with N >= 1")
        return _named_path(memory, captured, name, count=int(count or FRAMES))
    if path == CAPTURED:
        return captured
    place, at, selection = path.partition("@")
    if not Path(place).exists():
        raise OptionError(f"--path {path!r}; expected {FORMS}")
    from gvtools.scenes.selection import select

    if Path(place).suffix.lower() == ".json":
        from gvtools.scenes.transforms_json import read_transforms_cameras

        cameras = read_transforms_cameras(Path(place))
        return cameras[list(map(cameras.names.index, select(cameras.names, selection or "all")))]
    if Path(place).is_dir():
        from gvtools.scenes.project import open_project

        scene = open_project(Path(place))
        return scene.subset(select(scene.names, selection if at else "all")).cameras
    from gvtools.trajectory_files import read_trajectory

    return read_trajectory(Path(place), captured[0])


def _named_path(memory: SpatialMemory, captured: Cameras, name: str, *, count: int) -> Cameras:
    def depth() -> tuple[Cameras, float] | None:
        middle = captured[len(captured) // 2]
        guidance = memory.project(middle)
        if not guidance.valid.any():
            return None
        return middle, float(np.median(guidance.depth[guidance.valid]))

    return named_path(name, captured, count=count, depth=depth)
