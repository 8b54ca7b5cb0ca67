"""A picture with its camera and, where known, its depth: what metrics between views compare."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ShapeError


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """One view, observed or generated.

    Attributes:
        name: the view's.
        camera: a batch of one, where the picture is meant to be seen from.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 z-depth, scene units, 0 = none; None when there is none.
        mask: (H, W) bool, True = use; None means all.
    """

    name: str
    camera: Cameras
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    mask: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        size = (int(self.camera.height[0]), int(self.camera.width[0]))
        if len(self.camera) != 1 or self.rgb.shape != (*size, 3) or self.rgb.dtype != np.uint8:
            raise ShapeError(
                f"picture {self.name}: rgb {self.rgb.dtype} {self.rgb.shape} with "
                f"{len(self.camera)} camera(s) of {size[1]}x{size[0]} pixels; expected one camera "
                "and uint8 rgb of its size"
            )
        for what, value in (("depth", self.depth), ("mask", self.mask)):
            if value is not None and value.shape != size:
                raise ShapeError(
                    f"picture {self.name}: {what} {value.shape}; expected {size} like rgb"
                )
        if self.mask is not None and self.mask.dtype != np.bool_:
            raise ShapeError(f"picture {self.name}: mask {self.mask.dtype}; expected bool")
