"""Cameras and pictures in Aria's VRS files, through the official ``projectaria_tools``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.optional import require
from gvtools.scenes.photographs import Depth
from gvtools.scenes.rgbd_recording import MILLIMETRES
from gvtools.scenes.scene import Frame
from gvtools.scenes.transforms_frame import LensParameters

if TYPE_CHECKING:
    import pycolmap

Float64 = NDArray[np.float64]

RGB_STREAM, RGB_LABEL = "214-1", "camera-rgb"
FISHEYE = "RAD_TAN_THIN_PRISM_FISHEYE"  # COLMAP's name of Aria's FISHEYE624
OPEN_FILES = 4  # that are kept open in a process


@dataclass(frozen=True, eq=False)
class AriaCamera:
    """The calibration of an Aria camera, and the pinhole that its pictures are brought to.

    The pinhole has the fisheye's size and focal length, its principal point in the middle, and the
    same axes: its picture lies wholly inside the fisheye's round one.

    Attributes:
        lens: of the fisheye, pixels, first pixel's centre (0.5, 0.5).
        radius: within which the sensor sees anything, pixels from the principal point.
        device_from_cam: (4, 4) float64, metres.
    """

    lens: LensParameters
    radius: float
    device_from_cam: Float64

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
    """The depth map that belongs to a picture of the colour camera; the nearest in time.

    Args:
        path: ``depth_images.vrs``, whose streams name the recorded streams that they belong to.
        time: nanoseconds of the device's clock.
        camera: of the recording.
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
    try:
        provider = _tools().data_provider.create_vrs_data_provider(str(path))
    except RuntimeError as error:
        raise ProjectError(f"{path}: no readable VRS file ({error}); copy it again") from None
    if provider is None:
        raise ProjectError(f"{path}: no readable VRS file; copy it again")
    return provider


def _tools() -> Any:
    for part in ("data_provider", "sensor_data", "stream_id"):
        require(f"projectaria_tools.core.{part}", extra="aria", purpose="reading Aria's recordings")
    return import_module("projectaria_tools.core")
