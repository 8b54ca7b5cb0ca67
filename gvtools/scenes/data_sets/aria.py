"""Aria Digital Twin: ``[SEQUENCE/]RECORDING/{video.vrs, depth_images.vrs, aria_trajectory.csv}``.

The recording is a VRS file, read through the official ``projectaria_tools``; its colour camera (a
fisheye of 1408x1408) becomes a pinhole. The trajectory is world_from_device in metres by the
device's clock (microseconds); frames between two poses get their interpolation. Quaternions are
stored w x y z in version 1.0 of the data set (``metadata.json`` or ``gt-metadata.json``; 1.0 where
it names none) and x y z w since. Depth is of the same fisheye pixels, millimetres along z. The
glasses' colour sensor lies on its side: pictures are read as stored, not turned upright.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.errors import ProjectError
from gvtools.optional import require
from gvtools.scenes.calibration import MILLIMETRES, Float64, quaternion_pose
from gvtools.scenes.images import readings
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import pose_at, scenes_holding
from gvtools.scenes.photographs import Depth, PosedFrame, posed_scene
from gvtools.scenes.scene import Finding, Frame, Scene
from gvtools.scenes.undistort import Undistortion, camera_of, pinhole_camera
from gvtools.untrusted import expect, read_json, read_text, reading

VIDEO, TRAJECTORY, DEPTH = "video.vrs", "aria_trajectory.csv", "depth_images.vrs"
METADATA = ("metadata.json", "gt-metadata.json")
FIRST_VERSION = "1.0"
SAME, LONGEST_GAP = 1_000, 100_000_000  # nanoseconds


def _scenes(root: Path) -> tuple[str, ...]:
    found = scenes_holding(root, f"*/{VIDEO}", f"*/*/{VIDEO}")
    return tuple(name for name in found if (root / name / TRAJECTORY).is_file())


@Layout.of_reader(f"SEQUENCE/{VIDEO} with {TRAJECTORY} and {DEPTH}", _scenes)
def _aria_digital_twin(root: Path, scene: str) -> Scene:
    folder = root / scene
    version = _version(folder)
    times, world_from_device = read_trajectory(folder / TRAJECTORY, version=version)
    lens, device_from_cam = rgb_camera(folder / VIDEO)
    cam_from_world = invert_rigid(world_from_device @ device_from_cam)
    video, depth, pictures = folder / VIDEO, folder / DEPTH, []
    present = depth if depth.is_file() else None
    for i, time in enumerate(rgb_times(video)):
        pose = pose_at(time, times, cam_from_world, same=SAME, longest_gap=LONGEST_GAP)
        reader, read = partial(read_rgb_depth, time=time), partial(read_rgb, index=i)
        pictures.append(PosedFrame(str(time), video, lens, pose, present, reader, read=read))
    findings = [Finding("info", f"quaternions of version {version}")]
    return posed_scene(folder, pictures, poses="cam_from_world", metric=True, findings=findings)


def _version(folder: Path) -> str:
    """The data set's version, which tells the order of quaternions."""
    for path in (home / name for home in (folder, folder.parent) for name in METADATA):
        if path.is_file():
            with reading(path, "expected a JSON object; copy it again"):
                return str(read_json(path).get("dataset_version", FIRST_VERSION))
    raise ProjectError(
        f"{folder}: neither {' nor '.join(METADATA)}, which tell the order of quaternions; "
        "complete the download"
    )


def read_trajectory(path: Path, *, version: str) -> tuple[Float64, Float64]:
    """The glasses' trajectory: (N,) nanoseconds, increasing, and (N, 4, 4) world_from_device."""
    with reading(path, "expected a head, 20 columns and a pose in each row; copy it again"):
        rows = list(csv.reader(read_text(path).splitlines()))[1:]
        values = np.array([[row[1], *row[3:10]] for row in rows if row], np.float64)
        expect(len(values), "no pose")
    values = values[np.argsort(values[:, 0], kind="stable")]
    quaternions = values[:, 4:]
    if version != FIRST_VERSION:
        quaternions = quaternions[:, [3, 0, 1, 2]]
    poses = [quaternion_pose(q, t) for q, t in zip(quaternions, values[:, 1:4], strict=True)]
    return values[:, 0] * 1000, np.stack(poses)


RGB_STREAM, RGB_LABEL = "214-1", "camera-rgb"
FISHEYE = "RAD_TAN_THIN_PRISM_FISHEYE"  # COLMAP's name of Aria's FISHEYE624
OPEN_FILES = 4  # that are kept open in a process


@dataclass(frozen=True, eq=False)
class AriaLens(Undistortion):
    """From the fisheye to a pinhole with its size and focal length, whose picture lies inside."""

    radius: float = np.inf  # within which the sensor sees anything, pixels from the principal point

    def image(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """As of any lens, black where nothing is seen."""
        return np.where((self._source_pixel >= 0)[..., None], super().image(rgb), np.uint8(0))

    @cached_property
    def _source_pixel(self) -> NDArray[np.int32]:
        off = self.source_positions() - self.source.params[2:4]
        with np.errstate(invalid="ignore"):
            seen = np.hypot(off[..., 0], off[..., 1]) <= self.radius
        return np.where(seen, self.flat_pixels(), -1).astype(np.int32)


def aria_lens(params: Sequence[float], size: tuple[int, int], radius: float) -> AriaLens:
    """The lens of Aria's FISHEYE624 parameters, pixels, whose first pixel's centre is (0, 0)."""
    focal, cx, cy, *distortion = params
    fisheye = (focal, focal, cx + 0.5, cy + 0.5, *distortion)
    target = pinhole_camera((focal, focal, size[0] / 2, size[1] / 2), size)
    source = camera_of(FISHEYE, fisheye, size, what="Aria's colour camera")
    return AriaLens(source, target, False, radius)


def rgb_camera(path: Path) -> tuple[AriaLens, Float64]:
    """The colour camera of a recording, and (4, 4) device_from_cam, metres."""
    calibration = _provider(path).get_device_calibration()
    camera = None if calibration is None else calibration.get_camera_calib(RGB_LABEL)
    if camera is None:
        raise ProjectError(f"{path}: no calibration of {RGB_LABEL}; copy the recording again")
    values = [float(value) for value in camera.get_projection_params()]
    width, height = (int(side) for side in camera.get_image_size())
    radius = camera.get_valid_radius()
    lens = aria_lens(values, (width, height), np.inf if radius is None else float(radius))
    return lens, np.asarray(camera.get_transform_device_camera().to_matrix(), np.float64)


def rgb_times(path: Path) -> list[int]:
    """Nanoseconds of the device's clock at which the colour camera took each picture."""
    tools = _tools()
    stream = tools.stream_id.StreamId(RGB_STREAM)
    times = _provider(path).get_timestamps_ns(stream, tools.sensor_data.TimeDomain.DEVICE_TIME)
    return [int(time) for time in times]


def read_rgb(path: Path, *, index: int) -> Frame:
    """A picture of the colour camera."""
    stream = _tools().stream_id.StreamId(RGB_STREAM)
    data, _ = _provider(path).get_image_data_by_index(stream, index)
    return Frame(_array(data, path))


def read_rgb_depth(path: Path, *, time: int) -> Depth:
    """The depth map of a picture of the colour camera: the nearest in time, nanoseconds."""
    sensors, provider = _tools().sensor_data, _provider(path)
    for stream in provider.get_all_streams():
        if provider.get_image_configuration(stream).description == RGB_STREAM:
            clock, nearest = sensors.TimeDomain.DEVICE_TIME, sensors.TimeQueryOptions.CLOSEST
            data, _ = provider.get_image_data_by_time_ns(stream, time, clock, nearest)
            return readings(_array(data, path), unit=MILLIMETRES)
    raise ProjectError(f"{path}: no stream of {RGB_STREAM}; copy it again")


def _array(data: Any, path: Path) -> NDArray[Any]:
    if not data.is_valid():
        raise ProjectError(f"{path}: an unreadable picture; copy the recording again")
    return np.ascontiguousarray(data.to_numpy_array())


@lru_cache(maxsize=OPEN_FILES)
def _provider(path: Path) -> Any:
    """What reads a VRS file; opening one reads its whole index."""
    with reading(path, "expected a VRS file; copy it again"):
        provider = _tools().data_provider.create_vrs_data_provider(str(path))
        expect(provider is not None, "no recording")
    return provider


def _tools() -> Any:
    for part in ("data_provider", "sensor_data", "stream_id"):
        require(f"projectaria_tools.core.{part}", extra="aria", purpose="reading Aria's recordings")
    return import_module("projectaria_tools.core")


LAYOUTS = (_aria_digital_twin,)
