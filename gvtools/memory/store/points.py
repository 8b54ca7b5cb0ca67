"""Coloured points on their way into the memory, and the camera that saw them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ShapeError
from gvtools.memory.store.local_frame import LocalFrame


@dataclass(frozen=True, eq=False)
class PointSet:
    """N points seen by one camera.

    Attributes:
        positions: (N, 3) float32, scene units, in ``frame``.
        colors: (N, 3) uint8.
        confidence: (N,) float32 > 0.
        spacing: (N,) float32, scene units: the width of the surface patch a point stands for.
        camera: the camera that saw them (a batch of one).
        frame: of the memory that they are for.
        free_depth: (h, w) float32, scene units: a coarse grid over the camera's image; space
            nearer than this along a cell's rays was seen to be empty, 0 where nothing is known.
        dropped: how many pixels gave no point, by reason.
    """

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    spacing: NDArray[np.float32]
    camera: Cameras
    frame: LocalFrame
    free_depth: NDArray[np.float32] | None
    dropped: dict[str, int]

    def __post_init__(self) -> None:
        count = len(self.positions)
        for name, array, shape in (
            ("positions", self.positions, (count, 3)),
            ("colors", self.colors, (count, 3)),
            ("confidence", self.confidence, (count,)),
            ("spacing", self.spacing, (count,)),
        ):
            if array.shape != shape:
                raise ShapeError(f"points: {name} has shape {array.shape}; expected {shape}")

    def __len__(self) -> int:
        return len(self.positions)
