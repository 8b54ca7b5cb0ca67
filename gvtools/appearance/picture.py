"""Gaussians as one camera sees them."""

from __future__ import annotations

from collections.abc import Sequence
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
    def of(cls, splat: Splat, *, gain: NDArray[np.float32] | None = None) -> Picture:
        """The picture of Gaussians that were splatted.

        Args:
            splat: of one camera.
            gain: (3,) what its red, green and blue are multiplied by; None leaves them.
        """
        alpha = splat.image[4]
        rgb = splat.image[:3] if gain is None else splat.image[:3] * gain[:, None, None]
        rgb = np.clip(rgb, 0, 1).transpose(1, 2, 0)
        depth = splat.image[3] / np.maximum(alpha, np.float32(1e-6))
        return cls(np.ascontiguousarray(rgb), depth, alpha)

    @property
    def solid(self) -> NDArray[np.bool_]:
        """(H, W) pixels that show a surface."""
        return self.alpha > SOLID


def mean_picture(pictures: Sequence[Picture]) -> Picture:
    """The mean of what several fits show; depth is the median of those that show a surface.

    With an even number it is the nearer of the middle two: their mean may be where neither has one.

    >>> near, far = (
    ...     Picture(*(np.full((1, 1, *more), value, np.float32) for more, value in parts))
    ...     for parts in (
    ...         [([3], 0.2), ([], 2.0), ([], 1.0)],
    ...         [([3], 0.4), ([], 8.0), ([], 1.0)],
    ...     )
    ... )
    >>> both = mean_picture([near, far])
    >>> round(float(both.rgb[0, 0, 0]), 2), float(both.depth[0, 0])
    (0.3, 2.0)
    """
    if len(pictures) == 1:
        return pictures[0]
    solid = np.array([picture.solid for picture in pictures])
    depth = np.array([picture.depth for picture in pictures])
    order = np.sort(np.where(solid, depth, np.float32(np.inf)), axis=0)
    middle = np.maximum(solid.sum(axis=0) - 1, 0) // 2
    median = np.take_along_axis(order, middle[None], axis=0)[0]
    return Picture(
        np.mean([picture.rgb for picture in pictures], axis=0),
        np.where(np.isfinite(median), median, depth[0]),
        np.mean([picture.alpha for picture in pictures], axis=0),
    )
