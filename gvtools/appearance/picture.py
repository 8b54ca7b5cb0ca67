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

    Colours are over black: darker where Gaussians stop less than all light.

    Attributes:
        rgb: (H, W, 3) float32 from 0 to 1.
        alpha: (H, W) float32, the share of light that they stop.
    """

    rgb: NDArray[np.float32]
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
        return cls(np.ascontiguousarray(rgb), alpha)

    @property
    def solid(self) -> NDArray[np.bool_]:
        """(H, W) pixels that show a surface."""
        return self.alpha > SOLID


def mean_picture(pictures: Sequence[Picture]) -> Picture:
    """The mean of what several fits show.

    >>> dark, light = (
    ...     Picture(np.full((1, 1, 3), grey, np.float32), np.ones((1, 1), np.float32))
    ...     for grey in (0.2, 0.4)
    ... )
    >>> round(float(mean_picture([dark, light]).rgb[0, 0, 0]), 2)
    0.3
    """
    if len(pictures) == 1:
        return pictures[0]
    return Picture(
        np.mean([picture.rgb for picture in pictures], axis=0),
        np.mean([picture.alpha for picture in pictures], axis=0),
    )
