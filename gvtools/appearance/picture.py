"""Gaussians as one camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.splat import Splat

# Gaussians show a surface where they stop this share of the light.
SOLID = 0.5


@dataclass(frozen=True, eq=False)
class Picture:
    """What one camera sees.

    Colours are over black, as they were fitted: where Gaussians stop less than all light, their own
    colours are brighter than the photographs'. Depth is that of the surface alone.

    Attributes:
        rgb: (H, W, 3) float32 from 0 to 1.
        depth: (H, W) float32 z-depth, scene units.
        alpha: (H, W) float32, the share of light that they stop.
    """

    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    alpha: NDArray[np.float32]

    @classmethod
    def of(cls, splat: Splat) -> Picture:
        """The picture of Gaussians that were splatted."""
        alpha = splat.image[4]
        rgb = np.clip(splat.image[:3], 0, 1).transpose(1, 2, 0)
        depth = splat.image[3] / np.maximum(alpha, np.float32(1e-6))
        return cls(np.ascontiguousarray(rgb), depth, alpha)

    @property
    def solid(self) -> NDArray[np.bool_]:
        """(H, W) pixels that show a surface."""
        return self.alpha > SOLID
