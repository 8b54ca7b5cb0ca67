"""Panoramas and fisheye pictures of the memory: pinhole faces that overlap, joined without seams.

Everything that draws the memory, fits and completers takes pinhole cameras. A picture of another
lens is therefore drawn as faces of a cube about its centre (see ``scenes.undistort``), each wider
than 90 degrees. Where each of its pixels lies in the faces is computed once for all pictures.

*Equirectangular*: all directions, longitude across and latitude down, straight ahead in the middle;
the scene's vertical is the picture's. *Fisheye*: equidistant, a circle whose radius is half the
field of view; the camera's own axes, black outside. Depth is the distance along the ray in both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from gvtools.cameras import Cameras, concatenate, invert_rigid
from gvtools.errors import OptionError
from gvtools.guidance import IMAGES, Guidance
from gvtools.scenes.undistort import (
    FACE_DEGREES,
    PANORAMA,
    Face,
    camera_of,
    face_name,
    panorama_faces,
    picture_of,
)
from gvtools.settings import Settings
from gvtools.trajectories import level_up, look_at

Float32 = NDArray[np.float32]

# What a guidance holds that is no yes or no, beside colours.
AMOUNTS = ("depth", "confidence")
# Width of a picture unless told otherwise: as fine as the cameras, at most so much. [px]
WIDEST_STILL, WIDEST_FRAME = 4096, 2048


class LensOptions(Settings):
    """The lens of target pictures."""

    section = "lens"

    kind: Literal["perspective", "equirectangular", "fisheye"] = "perspective"
    """Perspective as the cameras are, equirectangular (a panorama of all directions, level), or
    fisheye (equidistant)."""
    width: int | None = Field(None, ge=16, le=16384)
    """Of a panorama or fisheye picture; none: as fine as the cameras, within limits. [px]"""
    field_of_view: float = Field(180.0, ge=10, le=360)
    """Across a fisheye's circle. [degrees]"""

    @model_validator(mode="after")
    def _check(self) -> LensOptions:
        """Nothing is given that the lens does not heed."""
        if self.kind != "fisheye" and self.field_of_view != 180:
            raise OptionError(
                "lens.field_of_view or --field-of-view: belongs to --lens fisheye; give that or "
                "neither"
            )
        if self.kind == "perspective" and self.width is not None:
            raise OptionError(
                "lens.width: of panoramas and fisheye pictures; give lens.kind or --lens, too"
            )
        return self


@dataclass(frozen=True, eq=False)
class _Samples:
    """Where pixels of a picture lie in one face: those of a window of the picture."""

    window: tuple[slice, slice]
    xy: Float32  # (h, w, 2) pixels of the face, the first pixel's centre at 0
    weight: Float32  # (h, w), of all faces together 1
    leading: NDArray[np.bool_]  # (h, w) where this face weighs most
    length: Float32  # (h, w) of the ray with z = 1


@dataclass(frozen=True, eq=False)
class Rig:
    """Faces about one centre that together see what a picture of another lens shows."""

    lens: str  # "equirectangular" or "fisheye"
    size: tuple[int, int]  # of the picture, pixels
    faces: tuple[Face, ...]
    samples: tuple[_Samples, ...]  # of each face
    inside: NDArray[np.bool_]  # (H, W) what is picture, not outside of the circle

    @classmethod
    def of(cls, options: LensOptions, cameras: Cameras, *, widest: int) -> Rig | None:
        """The rig for pictures in the place of some cameras'; None for a perspective lens."""
        if options.kind == "perspective":
            return None
        angle = math.radians(options.field_of_view if options.kind == "fisheye" else 360)
        fine = float(np.median(cameras.K[:, 0, 0])) * angle
        # Halves and videos' chroma are of whole pixels.
        width = int(options.width or min(max(fine, 16), widest)) // 4 * 4
        size = (width, width // 2) if options.kind == "equirectangular" else (width, width)
        rays, inside = _rays(options.kind, size, angle)
        # As fine as the picture in its middle.
        wide = max(8, round(width / angle * math.pi) * 2)
        whole = camera_of(PANORAMA, (wide, wide // 2), (wide, wide // 2), what="a rig")
        faces = panorama_faces(whole, degrees=FACE_DEGREES)
        weights = np.stack([_weight(_turned(rays, face)) for face in faces])
        weights *= inside / np.maximum(weights.sum(axis=0), 1e-6)
        most = weights.argmax(axis=0)
        seen = [number for number in range(len(faces)) if weights[number].any()]
        samples = [
            _samples(faces[number], rays, weights[number], leading=(most == number) & inside)
            for number in seen
        ]
        return cls(options.kind, size, tuple(faces[n] for n in seen), tuple(samples), inside)

    def cameras(self, picture: Cameras) -> Cameras:
        """The faces' cameras of a picture's camera, a batch of one, with the names of faces."""
        (name,) = picture.names
        (pose,) = picture.cam_from_world
        parts = []
        for face in self.faces:
            names = (face_name(name, face.face),)
            parts.append(Cameras.alike(face.K, face.pose(pose), size=face.size, names=names))
        return concatenate(parts)

    def faces_of(self, pictures: Iterable[Cameras]) -> list[Cameras]:
        """The faces' cameras of all pictures', each a batch of one."""
        return [face for picture in pictures for face in self.cameras(picture)]

    def pictures(self, cameras: Cameras) -> Iterator[Cameras]:
        """The cameras of pictures whose faces ``cameras`` are; the first face gives the pose."""
        for first in range(0, len(cameras), len(self.faces)):
            turned = cameras.cam_from_world[first].copy()
            turned[:3] = self.faces[0].rotation.T @ turned[:3]
            name = picture_of(cameras.names[first])
            yield replace(cameras[first], cam_from_world=turned[None], names=(name,))

    def joined(self, faces: Iterable[Guidance], picture: Cameras) -> Guidance:
        """The picture of the faces, batches of one; colours are blended, all else the nearest's.

        Depth is the distance along the ray. ``picture`` gives centre, axes and name.
        """
        import cv2

        columns, rows = self.size
        rgb = np.zeros((rows, columns, 4), np.float32)
        flat: dict[str, NDArray[Any]] = {
            name: np.zeros((rows, columns), np.float32 if name in AMOUNTS else np.bool_)
            for name in IMAGES[1:]
        }
        for guidance, at in zip(faces, self.samples, strict=True):
            known = guidance.valid[0].astype(np.float32)[..., None]
            colors = np.concatenate([guidance.rgb[0] * known, known], axis=2)
            drawn = cv2.remap(
                colors, at.xy[..., 0], at.xy[..., 1], cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip
            rgb[at.window] += at.weight[..., None] * drawn
            column, row = np.rint(at.xy[at.leading]).astype(np.int64).T
            row = row.clip(0, guidance.valid.shape[1] - 1)
            column = column.clip(0, guidance.valid.shape[2] - 1)
            for name, values in flat.items():
                near = getattr(guidance, name)[0, row, column]
                values[at.window][at.leading] = (
                    near * at.length[at.leading] if name == "depth" else near
                )
        colors = np.asarray(rgb[..., :3] / np.maximum(rgb[..., 3:], 1e-6), np.float32)
        colors[~flat["valid"]] = 0
        camera = replace(picture, width=np.array([columns]), height=np.array([rows]))
        return Guidance(camera, colors[None], *(values[None] for values in flat.values()))


def picture_cameras(cameras: Cameras, options: LensOptions, *, captured: Cameras) -> Cameras:
    """Where pictures of a lens are taken in the place of ``cameras``: one for the faces of one.

    Panoramas are level, by the captured views; their middle is ahead of the camera. Fisheye
    pictures have the cameras' own axes.
    """
    first: dict[str, int] = {}
    for row, name in enumerate(cameras.names):
        picture = picture_of(name)
        if picture not in first or name == face_name(picture, "front"):
            first[picture] = row
    chosen = replace(cameras[list(first.values())], names=tuple(first))
    if options.kind != "equirectangular":
        return chosen
    up = level_up(captured)
    world = chosen.world_from_cam
    ahead, above = world[:, :3, 2], -world[:, :3, 1]
    # A camera that looks straight down has its own up ahead of it, and one that looks straight up
    # what is below it; others are led by where they look.
    steep = (ahead @ up)[:, None]
    heading = ahead - steep**5 * above
    heading -= (heading @ up)[:, None] * up
    level = look_at(np.zeros((len(chosen), 3)), heading, up=up)
    level[:, :3, 3] = world[:, :3, 3]
    return replace(chosen, cam_from_world=invert_rigid(level))


def _rays(kind: str, size: tuple[int, int], angle: float) -> tuple[Float32, NDArray[np.bool_]]:
    """(H, W, 3) unit directions of a picture's pixels, and (H, W) which show something."""
    width, height = size
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    x, y = x * angle / width, y * angle / width
    if kind == "equirectangular":
        rays = np.stack([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)], axis=-1)
        return rays.astype(np.float32), np.ones((height, width), np.bool_)
    theta = np.hypot(x, y)
    across = np.sinc(theta / np.pi)
    rays = np.stack([x * across, y * across, np.cos(theta)], axis=-1)
    return rays.astype(np.float32), theta <= angle / 2


def _turned(rays: Float32, face: Face) -> Float32:
    """(..., 3) directions of a picture as those of a face."""
    return np.asarray(rays @ face.rotation.T.astype(np.float32))


def _weight(local: Float32) -> Float32:
    """(H, W) of a face for directions in it: 1 where it is alone, 1/2 on the cube's edges."""
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.degrees(np.arctan(np.abs(local[..., :2]).max(axis=-1) / local[..., 2]))
    share = (FACE_DEGREES / 2 - off) / (FACE_DEGREES - 90)
    share = np.where(local[..., 2] > 0, np.clip(share, 0, 1), 0)
    return np.asarray(share * share * (3 - 2 * share), np.float32)


def _samples(face: Face, rays: Float32, weight: Float32, *, leading: NDArray[np.bool_]) -> _Samples:
    rows, columns = (np.flatnonzero((weight > 0).any(axis=axis)) for axis in (1, 0))
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    local = _turned(rays[window], face)
    local /= np.maximum(local[..., 2:], np.float32(1e-3))
    xy = (local @ face.K.T)[..., :2] - 0.5
    length = np.linalg.norm(local, axis=-1)
    return _Samples(
        window, xy.astype(np.float32), weight[window], leading[window], length.astype(np.float32)
    )
