"""The keys of a frame in a ``transforms.json``, its own over the file's, and the camera they tell.

The camera is given as COLMAP's model and parameter list.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, Field, ValidationError

from gvtools.errors import ProjectError
from gvtools.scenes.faces import PANORAMA
from gvtools.scenes.images import read_header

# nerfstudio's names; the fisheye ones share one model, the others the polynomial one.
PERSPECTIVE = ("", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

# Keys that each frame has for itself.
OF_A_FRAME = ("transform_matrix", "mask_path", "depth_file_path")

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
Pixels = Annotated[Number, Field(ge=1, le=200_000, multiple_of=1)]
Angle = Annotated[Number, Field(gt=0, lt=math.pi)]


class LensParameters(NamedTuple):
    """A camera model of COLMAP with its parameters in COLMAP's order, and its picture's size.

    Lengths are in pixels; the first pixel's centre is (0.5, 0.5).
    """

    model: str
    values: tuple[float, ...]
    size: tuple[int, int]


class FrameKeys(BaseModel):
    """What is read of a frame. None stands for an absent key; a key whose value is null is wrong.

    Keys as nerfstudio and instant-ngp have them.
    """

    transform_matrix: Any = None
    mask_path: str | None = None
    depth_file_path: str | None = None
    depth_unit_scale_factor: Positive = 1e-3
    camera_model: str = ""
    is_fisheye: Annotated[int, Field(ge=0, le=1)] | None = None
    w: Pixels = None  # type: ignore[assignment]
    h: Pixels = None  # type: ignore[assignment]
    fl_x: Positive = None  # type: ignore[assignment]
    fl_y: Positive = None  # type: ignore[assignment]
    camera_angle_x: Angle = None  # type: ignore[assignment]
    cx: Number = None  # type: ignore[assignment]
    cy: Number = None  # type: ignore[assignment]
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0

    def lens(self, picture: Path, *, what: str) -> LensParameters:
        """The recorded camera.

        Args:
            picture: tells the size where no key does.
            what: where the keys were read, for messages.
        """
        if self.w is None or self.h is None:
            header = read_header(picture)
            size = header.width, header.height
        else:
            size = int(self.w), int(self.h)
        center = (
            size[0] / 2 if self.cx is None else self.cx,
            size[1] / 2 if self.cy is None else self.cy,
        )
        if self.camera_model == PANORAMA:
            return LensParameters(PANORAMA, (float(size[0]), float(size[1])), size)
        shared: tuple[float, ...] = (*self._focal(size[0], what), *center)
        named = self.camera_model
        if named in FISHEYE or (not named and self.is_fisheye):
            return LensParameters(
                "OPENCV_FISHEYE", (*shared, self.k1, self.k2, self.k3, self.k4), size
            )
        if named not in PERSPECTIVE:
            raise ProjectError(
                f"{what}: the camera model {named} is not read; expected one of "
                f"{', '.join(name for name in (*PERSPECTIVE, *FISHEYE, PANORAMA) if name)}; "
                "render perspective views first"
            )
        if self.k4:
            raise ProjectError(
                f"{what}: k4 = {self.k4} of a perspective camera; expected k1, k2, k3, p1, p2 at "
                "most (tools disagree on what a fourth one means); set camera_model to "
                "OPENCV_FISHEYE if it is one, or calibrate without k4"
            )
        shared = (*shared, self.k1, self.k2, self.p1, self.p2)
        if self.k3:
            return LensParameters("FULL_OPENCV", (*shared, self.k3, 0.0, 0.0, 0.0), size)
        return LensParameters("OPENCV", shared, size)

    def _focal(self, width: int, what: str) -> tuple[float, float]:
        x = self.fl_y if self.fl_x is None else self.fl_x
        if x is not None:
            return x, x if self.fl_y is None else self.fl_y
        if self.camera_angle_x is None:
            raise ProjectError(f"{what}: neither fl_x nor camera_angle_x; expected one of them")
        x = 0.5 * width / math.tan(0.5 * self.camera_angle_x)
        return x, x


def frame_keys(frame: Mapping[str, Any], shared: Mapping[str, Any], *, what: str) -> FrameKeys:
    """A frame's keys, checked.

    Args:
        frame: its own.
        shared: the file's, of which those of the camera stand in for absent ones of the frame.
        what: where they were read, for the message.
    """
    values = {key: shared[key] for key in shared if key not in OF_A_FRAME} | dict(frame)
    if "fl_x" in values or "fl_y" in values:
        values.pop("camera_angle_x", None)  # not looked at
    try:
        return FrameKeys.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise ProjectError(
            f"{what}: {first['loc'][0]} is {reprlib.repr(first['input'])}; expected "
            f"{first['msg'].removeprefix('Input should be ')}; mend it or export the file again"
        ) from None
