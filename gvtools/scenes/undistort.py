"""From a recorded camera, of any perspective model, to the pinhole camera that views have.

The mapping is pycolmap's own. Pictures are resampled bilinearly; masks and depth take the nearest
pixel of the same mapping. z-depth needs no change: undistortion turns no axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ProjectError
from gvtools.untrusted import reading

if TYPE_CHECKING:
    import pycolmap

# A detection whose ray projects back farther than this (pixels) lies where the distortion has no
# inverse.
ROUND_TRIP_TOLERANCE = 0.05
# Of a side of a picture; its border is walked where a lens is undistorted.
MOST_PIXELS = 200_000
# Cameras whose positions in the recorded picture are kept, six bytes a pixel.
KEPT = 4


class LensParameters(NamedTuple):
    """A camera model of COLMAP with its parameters in COLMAP's order, and its picture's size.

    Lengths are in pixels; the first pixel's centre is (0.5, 0.5).
    """

    model: str
    values: tuple[float, ...]
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Undistortion:
    """The mapping of one recorded camera."""

    source: pycolmap.Camera  # the recorded camera
    target: pycolmap.Camera  # the pinhole camera
    untouched: bool  # True when both are the same, so that nothing is resampled

    @property
    def K(self) -> NDArray[np.float64]:
        """(3, 3) float64 of the pinhole camera, pixels; first pixel centre (0.5, 0.5)."""
        return np.asarray(self.target.calibration_matrix(), np.float64)

    @property
    def source_size(self) -> tuple[int, int]:
        """Width and height of the recorded picture, pixels."""
        return int(self.source.width), int(self.source.height)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pinhole picture, pixels."""
        return int(self.target.width), int(self.target.height)

    @property
    def model(self) -> str:
        """COLMAP's name of the recorded camera's model."""
        return str(self.source.model_name)

    def name(self, picture: str) -> str:
        """The view's name, from the picture's."""
        return picture

    def pose(self, cam_from_world: ArrayLike) -> NDArray[np.float64]:
        """(4, 4) cam_from_world of the pinhole camera, from the recorded camera's."""
        return np.asarray(cam_from_world, np.float64)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """(h, w) recorded depth as (H, W) z-depth of the pinhole camera, by nearest pixel."""
        return self.nearest(depth)

    def image(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(h, w, 3) uint8 recorded picture as (H, W, 3) uint8 of the pinhole camera, bilinear."""
        import cv2

        if self.untouched:
            return rgb
        # Twenty times as fast as pycolmap's own, whose colours differ by one level at most.
        return np.asarray(cv2.remap(rgb, *_positions(self), cv2.INTER_LINEAR), np.uint8)

    def nearest(self, array: NDArray[Any]) -> NDArray[Any]:
        """(h, w) recorded values as (H, W) of the pinhole camera, by nearest pixel; 0 outside."""
        if self.untouched:
            return array
        values = array.reshape(-1)[np.maximum(self._source_pixel, 0)]
        return np.where(self._source_pixel >= 0, values, np.zeros((), array.dtype))

    @property
    def inside(self) -> NDArray[np.bool_] | None:
        """(H, W) bool, False where the pinhole camera looks past the picture; None if nowhere."""
        if self.untouched or (self._source_pixel >= 0).all():
            return None
        return self._source_pixel >= 0

    def points(self, xy: ArrayLike) -> NDArray[np.float64]:
        """(N, 2) recorded positions as (N, 2) of the pinhole camera; NaN without an inverse."""
        xy = np.asarray(xy, np.float64).reshape(-1, 2)
        if self.untouched or not len(xy):
            return xy
        ray = np.column_stack([np.asarray(self.source.cam_from_img(xy)), np.ones(len(xy))])
        with np.errstate(invalid="ignore"):
            back = np.asarray(self.source.img_from_cam(ray))
            sound = np.abs(back - xy).max(axis=1) <= ROUND_TRIP_TOLERANCE
        flat = ray @ self.K.T
        return np.where(sound[:, None], flat[:, :2], np.nan)

    @cached_property
    def _source_pixel(self) -> NDArray[np.int32]:
        return self.flat_pixels()

    def flat_pixels(self) -> NDArray[np.int32]:
        """(H, W) int32, the flat index of the recorded pixel seen by each pixel; -1 for none."""
        source = self.source_positions()
        w, h = self.source_size
        with np.errstate(invalid="ignore"):
            inside = np.all((source >= 0) & (source < (w, h)), axis=2)
        pixel = np.floor(np.where(inside[..., np.newaxis], source, 0)).astype(np.int32)
        return np.where(inside, pixel[..., 1] * w + pixel[..., 0], -1)

    def source_positions(self) -> NDArray[np.float64]:
        """(H, W, 2) where the centre of each pixel is in the recorded picture, pixels."""
        width, height = self.size
        y, x = np.mgrid[:height, :width] + 0.5
        ray = np.ones((width * height, 3))
        ray[:, 0] = ((x - self.K[0, 2]) / self.K[0, 0]).ravel()
        ray[:, 1] = ((y - self.K[1, 2]) / self.K[1, 1]).ravel()
        return np.asarray(self.source.img_from_cam(ray)).reshape(height, width, 2)


@lru_cache(maxsize=KEPT)
def _positions(lens: Undistortion) -> tuple[NDArray[Any], NDArray[Any]]:
    """Where the pixels are in the recorded picture, as OpenCV wants it: in fixed point."""
    import cv2

    at = np.nan_to_num(lens.source_positions() - 0.5, nan=-1e4).astype(np.float32)
    return cv2.convertMaps(at[..., 0], at[..., 1], cv2.CV_16SC2)


def undistortion(
    model: str, params: Sequence[float] | NDArray[np.float64], size: tuple[int, int], *, what: str
) -> Undistortion:
    """The mapping of a camera of COLMAP's; pinholes without distortion are passed untouched."""
    from gvtools.colmap import pycolmap

    camera = camera_of(model, params, size, what=what)
    if not camera.is_perspective():
        raise ProjectError(
            f"{what}: the camera model {model} is spherical and has no pinhole image; expected a "
            "perspective model; give the panoramas as a COLMAP or transforms.json project"
        )
    if camera.is_perspective_pinhole() and camera.is_undistorted():
        target = pycolmap.Camera(
            model="PINHOLE",
            width=camera.width,
            height=camera.height,
            params=camera.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
        )
        return Undistortion(camera, target, True)
    with reading(f"{what}: {model} {list(params)}", "expected a lens that can be undistorted"):
        target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        if _impossible(target):
            raise ValueError(f"what results {_impossible(target)}; solve or export it again")
    return Undistortion(camera, target, False)


def camera_of(
    model: str, params: Sequence[float] | NDArray[np.float64], size: tuple[int, int], *, what: str
) -> pycolmap.Camera:
    """A camera of COLMAP from its model's name, parameters and size, checked."""
    from gvtools.colmap import pycolmap

    if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
        raise ProjectError(
            f"{what}: unknown camera model {model!r}; expected one of COLMAP's: "
            + ", ".join(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")
        )
    width, height = (int(value) for value in size)
    values = [float(value) for value in params]
    possible = 1 <= min(width, height) <= max(width, height) <= MOST_PIXELS
    side = (width, height) if possible else (1, 1)
    camera = pycolmap.Camera(model=model, width=side[0], height=side[1], params=values)
    wrong = _impossible(camera) if possible else "has an impossible size"
    if wrong:
        raise ProjectError(
            f"{what}: {model} {width}x{height} with parameters {values} {wrong}; "
            f"expected {camera.params_info}; solve or export the model again"
        )
    return camera


def _impossible(camera: pycolmap.Camera) -> str:
    """What is wrong with a camera's parameters; empty when nothing is."""
    if not camera.verify_params():
        return f"has {len(camera.params)} parameters"
    if not np.isfinite(camera.params).all():
        return "holds NaN or infinity"
    if min(camera.width, camera.height) < 1 or max(camera.width, camera.height) > MOST_PIXELS:
        return "has an impossible size"
    if camera.is_perspective() and min(camera.focal_length_x, camera.focal_length_y) <= 0:
        return "has a focal length that is not positive"
    return ""
