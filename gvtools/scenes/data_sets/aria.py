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
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.errors import ProjectError
from gvtools.optional import require
from gvtools.scenes.calibration import MILLIMETRES, Float64, quaternion_pose
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import pose_at, scenes_holding
from gvtools.scenes.photographs import Depth, PosedFrame, posed_scene
from gvtools.scenes.scene import Finding, Frame, Scene
from gvtools.scenes.undistort import LensParameters
from gvtools.untrusted import read_json, read_text, reading

if TYPE_CHECKING:
    import pycolmap

VIDEO, TRAJECTORY, DEPTH = "video.vrs", "aria_trajectory.csv", "depth_images.vrs"
METADATA = ("metadata.json", "gt-metadata.json")
FIRST_VERSION = "1.0"
SAME, LONGEST_GAP = 1_000, 100_000_000  # nanoseconds


def _scenes(root: Path) -> tuple[str, ...]:
    found = scenes_holding(root, f"*/{VIDEO}", f"*/*/{VIDEO}")
    return tuple(name for name in found if (root / name / TRAJECTORY).is_file())


def _read(root: Path, scene: str) -> Scene:
    folder = root / scene
    version = _version(folder)
    times, world_from_device = read_trajectory(folder / TRAJECTORY, version=version)
    camera = rgb_camera(folder / VIDEO)
    cam_from_world = invert_rigid(world_from_device @ camera.device_from_cam)
    depth = folder / DEPTH
    pictures = [
        PosedFrame(
            str(time),
            folder / VIDEO,
            camera.pinhole,
            pose_at(time, times, cam_from_world, same=SAME, longest_gap=LONGEST_GAP),
            depth if depth.is_file() else None,
            partial(read_rgb_depth, time=time, camera=camera),
            read=partial(read_rgb, index=i, camera=camera),
        )
        for i, time in enumerate(rgb_times(folder / VIDEO))
    ]
    (width, height), focal = camera.lens.size, camera.lens.values[0]
    line = f"Aria's fisheye {width}x{height} to PINHOLE with focal length {focal:.1f} px"
    findings = [Finding("info", f"{line}; quaternions of version {version}")]
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
        if not len(values):
            raise ValueError("no pose")
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
class AriaCamera:
    """The calibration of an Aria camera, and the pinhole that its pictures are brought to.

    The pinhole has the fisheye's size and focal length, its principal point in the middle, and the
    same axes: its picture lies wholly inside the fisheye's round one.
    """

    lens: LensParameters  # of the fisheye, pixels, first pixel's centre (0.5, 0.5)
    radius: float  # within which the sensor sees anything, pixels from the principal point
    device_from_cam: Float64  # (4, 4), metres

    @property
    def pinhole(self) -> LensParameters:
        """Of the views."""
        width, height = self.lens.size
        focal = self.lens.values[0]
        return LensParameters("PINHOLE", (focal, focal, width / 2, height / 2), self.lens.size)

    def picture(self, rgb: NDArray[np.uint8]) -> Frame:
        """(h, w, 3) recorded, as the pinhole sees it; the mask tells what is outside the lens."""
        import cv2

        x, y, seen = self._source
        shown = cv2.remap(rgb, x, y, cv2.INTER_LINEAR)
        return Frame(np.asarray(shown, np.uint8), mask=None if seen.all() else seen)

    def depth(self, recorded: NDArray[np.uint16]) -> Depth:
        """(h, w) recorded millimetres along z, as (h, w) float32 metres of the pinhole."""
        import cv2

        x, y, seen = self._source
        found = cv2.remap(recorded.astype(np.float32), x, y, cv2.INTER_NEAREST)
        return np.where(seen, found * np.float32(MILLIMETRES), np.float32(0))

    @cached_property
    def _source(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """For each pixel the recorded position, counted by pixels' centres, and whether seen."""
        width, height = self.lens.size
        focal, _, cx, cy = self.pinhole.values
        y, x = np.mgrid[:height, :width] + 0.5
        rays = np.stack([(x - cx) / focal, (y - cy) / focal, np.ones_like(x)], axis=-1)
        source = np.asarray(self._fisheye.img_from_cam(rays.reshape(-1, 3)))
        off = source - self.lens.values[2:4]
        with np.errstate(invalid="ignore"):
            seen = (np.hypot(*off.T) <= self.radius) & (source >= 0).all(axis=1)
            seen &= (source <= self.lens.size).all(axis=1)
        place = np.where(seen[:, None], source - 0.5, -1).astype(np.float32)
        columns, rows = place.T.reshape(2, height, width)
        return columns, rows, seen.reshape(height, width)

    @cached_property
    def _fisheye(self) -> pycolmap.Camera:
        import pycolmap

        width, height = self.lens.size
        return pycolmap.Camera(
            model=self.lens.model, width=width, height=height, params=list(self.lens.values)
        )


def rgb_camera(path: Path) -> AriaCamera:
    """The colour camera of a recording."""
    calibration = _provider(path).get_device_calibration()
    camera = None if calibration is None else calibration.get_camera_calib(RGB_LABEL)
    if camera is None:
        raise ProjectError(f"{path}: no calibration of {RGB_LABEL}; copy the recording again")
    values = [float(value) for value in camera.get_projection_params()]
    if len(values) != 15:
        raise ProjectError(
            f"{path}: {camera.get_model_name()} with {len(values)} parameters; expected Aria's "
            "FISHEYE624 with 15"
        )
    focal, cx, cy, *distortion = values
    width, height = (int(side) for side in camera.get_image_size())
    radius = camera.get_valid_radius()
    return AriaCamera(
        LensParameters(FISHEYE, (focal, focal, cx + 0.5, cy + 0.5, *distortion), (width, height)),
        np.inf if radius is None else float(radius),
        np.asarray(camera.get_transform_device_camera().to_matrix(), np.float64),
    )


def rgb_times(path: Path) -> list[int]:
    """Nanoseconds of the device's clock at which the colour camera took each picture."""
    tools = _tools()
    stream = tools.stream_id.StreamId(RGB_STREAM)
    times = _provider(path).get_timestamps_ns(stream, tools.sensor_data.TimeDomain.DEVICE_TIME)
    return [int(time) for time in times]


def read_rgb(path: Path, *, index: int, camera: AriaCamera) -> Frame:
    """A picture of the colour camera as a pinhole sees it."""
    stream = _tools().stream_id.StreamId(RGB_STREAM)
    data, _ = _provider(path).get_image_data_by_index(stream, index)
    return camera.picture(_array(data, path))


def read_rgb_depth(path: Path, *, time: int, camera: AriaCamera) -> Depth:
    """The depth map of a picture of the colour camera: the nearest in time, nanoseconds.

    Streams of ``depth_images.vrs`` name the recorded streams that they belong to.
    """
    tools, provider = _tools(), _provider(path)
    for stream in provider.get_all_streams():
        if provider.get_image_configuration(stream).description == RGB_STREAM:
            data, _ = provider.get_image_data_by_time_ns(
                stream,
                time,
                tools.sensor_data.TimeDomain.DEVICE_TIME,
                tools.sensor_data.TimeQueryOptions.CLOSEST,
            )
            return camera.depth(_array(data, path))
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
        if provider is None:
            raise ValueError("no recording")
    return provider


def _tools() -> Any:
    for part in ("data_provider", "sensor_data", "stream_id"):
        require(f"projectaria_tools.core.{part}", extra="aria", purpose="reading Aria's recordings")
    return import_module("projectaria_tools.core")


LAYOUTS = (
    Layout("aria_digital_twin", f"SEQUENCE/{VIDEO} with {TRAJECTORY} and {DEPTH}", _scenes, _read),
)
