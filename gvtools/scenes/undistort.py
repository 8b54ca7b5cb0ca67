"""From a recorded camera to the pinhole camera that views have, or to several of them.

The mapping is pycolmap's own. Pictures are resampled bilinearly; masks and depth take the nearest
pixel of the same mapping. z-depth needs no change: undistortion turns no axis.

No single pinhole camera holds a panorama or a wide fisheye picture. Such a picture becomes the
faces of a cube about its camera, each a pinhole camera of 90 degrees (or more, where faces have to
overlap) with the picture's centre and a known turn. Faces are named after the picture: ``room.jpg``
gives ``room@front.jpg``, ``room@left.jpg`` and so on.

Colour is bilinear where a face's pixels are finer than the picture's, and the mean of several such
samples where they are coarser, as at the poles of a panorama. Masks and depth take the nearest
pixel. Depth of a panorama is the distance along the ray; depth of a fisheye picture is z of the
recorded camera; both become z of the face.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import rigid_poses
from gvtools.errors import ProjectError
from gvtools.untrusted import expect, reading

if TYPE_CHECKING:
    import pycolmap

Float64 = NDArray[np.float64]

# A detection whose ray projects back farther than this (pixels) lies where the distortion has no
# inverse.
ROUND_TRIP_TOLERANCE = 0.05
# Of a side of a picture; its border is walked where a lens is undistorted.
MOST_PIXELS = 200_000
# Cameras whose positions in the recorded picture are kept, six bytes a pixel.
KEPT = 4
PANORAMA = "EQUIRECTANGULAR"
# Wider pictures of these models become several views. [degrees]
WIDEST = 120.0
# Models whose rays lie at theta (1 + k1 theta^2 + ...) from the principal point, and the indices of
# their k1, k2, ... in COLMAP's order. They reach past 90 degrees, where COLMAP's code does not.
EQUIDISTANT = {
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "SIMPLE_RADIAL_FISHEYE": (3,),
    "RADIAL_FISHEYE": (3, 4),
    "OPENCV_FISHEYE": (4, 5, 6, 7),
}
WIDE = (*EQUIDISTANT, "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "FOV", "EUCM")
# Yaw to the right and pitch upwards of each face. [degrees]
DIRECTIONS = {
    "front": (0, 0),
    "right": (90, 0),
    "back": (180, 0),
    "left": (270, 0),
    "up": (0, 90),
    "down": (0, -90),
}
FACE_NAME = re.compile(rf"^(.*)@(?:{'|'.join(DIRECTIONS)})(\.[^./@]+)?$")
# Field of view of a panorama's faces that overlap, so that neighbours share a margin. [degrees]
FACE_DEGREES = 100.0
# A face that sees less than this share of itself is left out.
LEAST_SEEN = 0.05
# Beyond this angle, the corners of a picture are taken for the dark outside of the image circle,
# unless the middles of its sides reach as far. [degrees]
CORNERS = 95.0
# z-depth of a fisheye's pixel counts where its unit ray's z is at least this (89 degrees).
GRAZING = 0.0175
# At most this many samples along a pixel's side.
MOST_SAMPLES = 4


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
    def K(self) -> Float64:
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

    def pose(self, cam_from_world: ArrayLike) -> Float64:
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

    def points(self, xy: ArrayLike) -> Float64:
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

    def source_positions(self) -> Float64:
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
    model: str, params: Sequence[float] | Float64, size: tuple[int, int], *, what: str
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
        K = camera.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]]
        return Undistortion(camera, pinhole_camera(K, (camera.width, camera.height)), True)
    with reading(f"{what}: {model} {list(params)}", "expected a lens that can be undistorted"):
        target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        wrong = _impossible(target)
        expect(not wrong, f"what results {wrong}; solve or export it again")
    return Undistortion(camera, target, False)


def camera_of(
    model: str, params: Sequence[float] | Float64, size: tuple[int, int], *, what: str
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


# --- faces of pictures that no single pinhole camera holds --------------------------------------


def face_name(picture: str, face: str) -> str:
    """The name of a picture's face.

    >>> face_name("hall/room.1.jpg", "left")
    'hall/room.1@left.jpg'
    """
    folder, slash, file = picture.rpartition("/")
    stem, dot, suffix = file.rpartition(".")
    if not stem:
        return f"{picture}@{face}"
    return f"{folder}{slash}{stem}@{face}{dot}{suffix}"


def picture_of(name: str) -> str:
    """The picture that a view shows a face of; of any other view its own name.

    >>> picture_of("hall/room.1@left.jpg"), picture_of("a@b.jpg")
    ('hall/room.1.jpg', 'a@b.jpg')
    """
    match = FACE_NAME.match(name)
    return name if match is None else match[1] + (match[2] or "")


def face_rotation(face: str) -> Float64:
    """(3, 3) float64, turns directions of the picture's camera into those of a face."""
    from scipy.spatial.transform import Rotation

    yaw, pitch = DIRECTIONS[face]
    turn = Rotation.from_euler("YX", [yaw, pitch], degrees=True)
    return np.round(turn.as_matrix().T)


@dataclass(frozen=True, eq=False)
class Face(Undistortion):
    """The mapping of one recorded camera to one of its faces."""

    face: str = "front"  # "front", "right", "back", "left", "up" or "down"
    # the greatest angle from the optical axis that the picture shows, radians
    limit: float = math.pi
    rotation: Float64 = field(default_factory=lambda: np.eye(3))

    def name(self, picture: str) -> str:
        """The view's name."""
        return face_name(picture, self.face)

    def pose(self, cam_from_world: ArrayLike) -> Float64:
        """(4, 4) of the face from (4, 4) of the recorded camera."""
        return rigid_poses(self.rotation) @ np.asarray(cam_from_world, np.float64)

    def image(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(h, w, 3) uint8 recorded picture as (H, W, 3) uint8 of the face; 0 where unseen."""
        import cv2

        border = 2
        padded = _padded(rgb, border, wraps=self.source.model_name == PANORAMA)
        width, height = self.size
        samples = self._samples
        picture = np.empty((height, width, 3), np.uint8)
        # By strips, since the samples of a large face fill memory.
        for top in range(0, height, 256):
            bottom = min(top + 256, height)
            # Samples past the edge of what counts are of its pixels still.
            xy = self._source_xy(samples, rows=(top, bottom), everywhere=True)
            xy = np.nan_to_num(xy, nan=-1e4) + np.float32(border - 0.5)
            strip = cv2.remap(
                padded, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            if samples > 1:
                size = width, bottom - top
                strip = cv2.resize(strip, size, interpolation=cv2.INTER_AREA)
            picture[top:bottom] = strip
        picture[self._source_pixel < 0] = 0
        return picture

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """(h, w) recorded depth as (H, W) float32 z-depth of the face; 0 where there is none."""
        near = self.nearest(depth)
        rays = self._rays(1, (0, self.size[1]))
        length = np.linalg.norm(rays, axis=-1)
        if self.source.model_name == PANORAMA:
            return np.asarray(near / length, np.float32)
        # By the ray of the recorded pixel: near 90 degrees its z says little about its neighbour's.
        forward = np.where(self._recorded_z > GRAZING, self._recorded_z, np.inf)
        return np.asarray(near / forward / length, np.float32)

    def points(self, xy: ArrayLike) -> Float64:
        """(N, 2) recorded pixel positions as (N, 2) of the face; NaN for those it does not show."""
        xy = np.asarray(xy, np.float64).reshape(-1, 2)
        if not len(xy):
            return xy
        rays = np.asarray(self.source.cam_ray_from_img(xy)).reshape(-1, 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            sound = np.abs(project(self.source, rays) - xy).max(axis=1) <= ROUND_TRIP_TOLERANCE
            local = rays @ self.rotation.T
            flat = (local @ self.K.T)[:, :2] / local[:, 2:]
            seen = (local[:, 2] > 0) & np.all((flat >= 0) & (flat < self.size), axis=1)
        return np.where((seen & sound)[:, None], flat, np.nan)

    @cached_property
    def _source_pixel(self) -> NDArray[np.int32]:
        """(H, W) int32, the flat index of the recorded pixel seen by each pixel; -1 for none."""
        width, height = self.source_size
        xy = self._source_xy(1, rows=(0, self.size[1]))
        with np.errstate(invalid="ignore"):
            seen = np.logical_and(*np.isfinite(np.moveaxis(xy, -1, 0)))
        column, row = np.floor(np.where(seen[..., None], xy, 0)).astype(np.int32).transpose(2, 0, 1)
        # Rays to the very edge of a panorama round to its width.
        flat = np.clip(row, 0, height - 1) * width + np.clip(column, 0, width - 1)
        return np.where(seen, flat, -1).astype(np.int32)

    @cached_property
    def _recorded_z(self) -> Float64:
        """(H, W), z of the unit rays of the recorded pixels that the face takes; 0 past them."""
        width = self.source_size[0]
        pixel = np.maximum(self._source_pixel, 0).ravel()
        xy = np.stack([pixel % width + 0.5, pixel // width + 0.5], axis=1)
        rays = np.asarray(self.source.cam_ray_from_img(xy)).reshape(-1, 3)
        z = rays[:, 2] / np.linalg.norm(rays, axis=1)
        with np.errstate(invalid="ignore"):
            sound = np.abs(project(self.source, rays) - xy).max(axis=1) <= ROUND_TRIP_TOLERANCE
        return np.where(sound, z, 0).reshape(self._source_pixel.shape)

    @cached_property
    def _samples(self) -> int:
        """Samples along a pixel's side: how far neighbours lie apart in the picture, rounded up."""
        xy = self._source_xy(1, rows=(0, self.size[1]))
        apart = []
        for axis in (0, 1):
            with np.errstate(invalid="ignore"):
                step = np.abs(np.diff(xy, axis=axis))
            # A step across the seam of a panorama is short.
            step[..., 0] = np.minimum(step[..., 0], np.abs(self.source_size[0] - step[..., 0]))
            apart.append(np.hypot(step[..., 0], step[..., 1]).ravel())
        steps = np.concatenate(apart)
        steps = steps[np.isfinite(steps)]
        if not len(steps):
            return 1
        return int(np.clip(math.ceil(float(np.quantile(steps, 0.95)) - 0.2), 1, MOST_SAMPLES))

    def _rays(self, samples: int, rows: tuple[int, int]) -> Float64:
        """(rows * samples, W * samples, 3), directions in the face with z = 1."""
        width = self.size[0]
        x = (np.arange(width * samples) + 0.5) / samples
        y = (np.arange(rows[0] * samples, rows[1] * samples) + 0.5) / samples
        rays = np.ones((len(y), len(x), 3))
        rays[..., 0] = (x - self.K[0, 2]) / self.K[0, 0]
        rays[..., 1] = ((y - self.K[1, 2]) / self.K[1, 1])[:, None]
        return rays

    def _source_xy(
        self, samples: int, *, rows: tuple[int, int], everywhere: bool = False
    ) -> NDArray[np.float32]:
        """Places in the picture of samples of some rows, pixels; NaN where nothing is seen."""
        rays = self._rays(samples, rows)
        local = rays.reshape(-1, 3) @ self.rotation
        xy = project(self.source, local)
        if self.source.model_name != PANORAMA and not everywhere:
            with np.errstate(invalid="ignore"):
                seen = np.all((xy >= 0) & (xy < self.source_size), axis=1)
                seen &= _angle(local) <= self.limit
            xy = np.where(seen[:, None], xy, np.nan)
        return xy.reshape(*rays.shape[:2], 2).astype(np.float32)


def perspective_views(
    model: str, params: Sequence[float] | Float64, size: tuple[int, int], *, what: str
) -> tuple[Undistortion, ...]:
    """The mappings of a camera to one pinhole camera, or to several where it sees too much for one.

    Panoramas become six faces; pictures of fisheye models that are wider than WIDEST become those
    of the faces that they show, cut to the part that they show. All others stay one view.
    Parameters are COLMAP's; ``what`` says where the camera was read.
    """
    camera = camera_of(model, params, size, what=what)
    if model == PANORAMA:
        if size[0] != 2 * size[1]:
            raise ProjectError(
                f"{what}: a panorama of {size[0]}x{size[1]}; expected twice as wide as high, all "
                "directions; fill what is missing with black, and mask it"
            )
        return panorama_faces(camera)
    if model in WIDE:
        across, limit = field_of_view(camera)
        if across > WIDEST:
            return _fisheye_faces(camera, limit)
    return (undistortion(model, params, size, what=what),)


def panorama_faces(camera: pycolmap.Camera, *, degrees: float = 90.0) -> tuple[Face, ...]:
    """The six faces of an equirectangular camera, as fine in the middle as its equator."""
    across = math.tan(math.radians(degrees / 2))
    half = max(1, round(camera.width / (2 * math.pi) * across))
    focal = half / across
    target = pinhole_camera((focal, focal, half, half), (2 * half, 2 * half))
    return tuple(Face(camera, target, False, face=face, rotation=face_rotation(face))
                 for face in DIRECTIONS)  # fmt: skip


def _fisheye_faces(camera: pycolmap.Camera, limit: float) -> tuple[Face, ...]:
    """Faces of 90 degrees of a fisheye camera, each cut to what the picture shows of it."""
    half = max(1, round(_focal(camera)))
    whole = pinhole_camera((half, half, half, half), (2 * half, 2 * half))
    faces = []
    for name in DIRECTIONS:
        turned = partial(Face, face=name, limit=limit, rotation=face_rotation(name))
        seen = turned(camera, whole, False)._source_pixel >= 0
        if seen.mean() < LEAST_SEEN:
            continue
        rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
        top, left = int(rows[0]), int(columns[0])
        cut = int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top
        target = pinhole_camera((half, half, half - left, half - top), cut)
        faces.append(turned(camera, target, False))
    return tuple(faces)


def pinhole_camera(params: Iterable[float], size: tuple[int, int]) -> pycolmap.Camera:
    """A camera of fx, fy, cx, cy, pixels."""
    from gvtools.colmap import pycolmap

    values = [float(value) for value in params]
    return pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=values)


def _focal(camera: pycolmap.Camera) -> float:
    """Pixels per radian in the middle of the picture."""
    step = 1e-3
    rays = np.array([[0.0, 0, 1], [step, 0, 1], [0, step, 1]])
    origin, x, y = project(camera, rays)
    return float(math.sqrt(abs(np.linalg.det(np.stack([x - origin, y - origin])))) / step)


def field_of_view(camera: pycolmap.Camera) -> tuple[float, float]:
    """The wider of a picture's two fields of view, degrees, and its greatest angle, radians.

    That is from the optical axis to the last pixel that counts: of the corners, or of the middles
    of the sides where the corners lie outside of the image circle.
    """
    theta = np.radians(np.arange(0.25, 180, 0.25))
    half: list[float] = []
    corners: list[float] = []
    fold = math.pi
    origin = project(camera, np.array([[0.0, 0.0, 1.0]]))
    for turn in np.radians(np.arange(0, 360, 45)):
        rays = np.stack([np.sin(theta) * math.cos(turn), np.sin(theta) * math.sin(turn),
                         np.cos(theta)], axis=1)  # fmt: skip
        xy = project(camera, rays)
        radius = np.linalg.norm(xy - origin, axis=1)
        with np.errstate(invalid="ignore"):
            grows = np.diff(radius, prepend=0.0) > 0
            inside = np.all((xy >= 0) & (xy <= (camera.width, camera.height)), axis=1)
        fold = min(fold, _last(theta, grows))
        on_axis = round(math.degrees(turn)) % 90 == 0
        (half if on_axis else corners).append(_last(theta, inside & grows))
    across = max(half[0] + half[2], half[1] + half[3])
    limit = max(*half, math.radians(CORNERS)) if max(corners) > math.radians(CORNERS) else math.pi
    return math.degrees(across), min(fold, limit)


def _last(theta: Float64, holds: NDArray[np.bool_]) -> float:
    """The last angle before a condition fails; 0 where it never holds."""
    count = len(theta) if holds.all() else int(np.argmin(holds))
    return float(theta[count - 1]) if count else 0.0


def project(camera: pycolmap.Camera, rays: Float64) -> Float64:
    """(N, 3) directions of a camera as (N, 2) pixels; NaN where the model shows nothing."""
    if camera.model_name not in EQUIDISTANT:
        return np.asarray(camera.img_from_cam(rays)).reshape(-1, 2)
    theta = _angle(rays)
    square = theta**2
    bent = np.ones_like(theta)
    for power, index in enumerate(EQUIDISTANT[camera.model_name], start=1):
        bent += camera.params[index] * square**power
    across = np.linalg.norm(rays[:, :2], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(across > 0, theta * bent / across, 1 / np.abs(rays[:, 2]))
    focal = camera.focal_length_x, camera.focal_length_y
    center = camera.principal_point_x, camera.principal_point_y
    return np.asarray(rays[:, :2] * scale[:, None] * focal + center)


def _angle(rays: Float64) -> Float64:
    """(N,) angle from the optical axis, radians."""
    return np.asarray(np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2]))


def _padded(rgb: NDArray[Any], border: int, *, wraps: bool) -> NDArray[Any]:
    """A picture with a border: of a panorama what lies across the seam and beyond the poles."""
    if not wraps:
        return np.pad(rgb, ((border, border), (border, border), (0, 0)), mode="edge")
    turned = np.roll(rgb, rgb.shape[1] // 2, axis=1)
    tall = np.concatenate([turned[:border][::-1], rgb, turned[-border:][::-1]])
    return np.ascontiguousarray(np.pad(tall, ((0, 0), (border, border), (0, 0)), mode="wrap"))
