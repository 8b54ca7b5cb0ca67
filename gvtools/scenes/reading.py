"""A project opened with what the user said of it, as plain data that a run records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.calibration import load_matrix
from gvtools.scenes.data_sets.address import is_address
from gvtools.scenes.project import open_project
from gvtools.scenes.rgbd import RgbdOptions

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene

# Options of a project by name, with the name that RgbdOptions has for those of RGB-D folders.
READING = {
    "root": None,
    "images": None,
    "masks": None,
    "model": None,
    "depth_unit": "depth_unit",
    "depth_max": "depth_max",
    "color_intrinsics": "color_K",
    "depth_intrinsics": "depth_K",
    "color_from_depth": "color_from_depth",
    "max_time_difference": "max_time_difference",
}


def open_as(path: Path, reading: Mapping[str, Any]) -> Scene:
    """The project at ``path``, read with options.

    Args:
        path: see ``gvtools.scenes.project.open_project``.
        reading: options by the names of READING, JSON-ready; absent and None leave the default.
            ``resolution``, width and height in pixels, is that of a benchmark: see
            ``gvtools.scenes.resized``.
    """
    folders = {
        name: None if reading.get(name) is None else Path(reading[name])
        for name in ("images", "masks", "root")
    }
    scene = open_project(path, **folders, rgbd=rgbd_options(reading), model=reading.get("model"))
    if reading.get("resolution") is None:
        return scene
    from gvtools.scenes.resized import resized

    width, height = reading["resolution"]
    return resized(scene, width, height)


def open_recorded(project: str, reading: Mapping[str, Any], *, moved: Path | None = None) -> Scene:
    """A project as a run recorded it.

    Args:
        project: of a run's record.
        reading: of the record.
        moved: where the project lies now, or where the download of its data set does; None: where
            it lay.
    """
    if moved is None:
        return open_as(Path(project), reading)
    if is_address(project) and not is_address(moved):
        return open_as(Path(project), {**reading, "root": str(moved)})
    return open_as(moved, reading)


def rgbd_options(reading: Mapping[str, Any]) -> RgbdOptions | None:
    """The options of RGB-D folders; None where there are none."""
    options = {
        option: reading[name]
        for name, option in READING.items()
        if option is not None and reading.get(name) is not None
    }
    if not options:
        return None
    if "color_from_depth" in options:
        path = Path(options["color_from_depth"])
        try:
            options["color_from_depth"] = load_matrix(path, (4, 4))
        except ProjectError as error:
            raise OptionError(f"--color-from-depth {error}") from None
    return RgbdOptions(**options)
