"""Gaussians as one camera sees them, and their colours blended with the memory's.

Gaussians are smooth, with small errors; the memory is sharp, with large errors where its depth is
wrong. The memory's detail is added to the Gaussians' colours where both agree after a blur.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.splat import Splat

# Gaussians show a surface where they stop this share of the light.
SOLID = 0.5
Float32 = NDArray[np.float32]

# Standard deviation of the blur [px].
BLUR = 3.0
# Values of Blend.share and Blend.tolerance that ``best_blend`` compares.
SHARES, TOLERANCES = (0.0, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0), (0.05, 0.1, 0.2, 0.4, 1.0, 4.0)


@dataclass(frozen=True, eq=False)
class Picture:
    """What one camera sees.

    Colours are over black: darker where Gaussians stop less than all light.
    """

    rgb: NDArray[np.float32]  # (H, W, 3) float32 from 0 to 1
    alpha: NDArray[np.float32]  # (H, W) float32, the share of light that they stop

    @classmethod
    def of(cls, splat: Splat, *, gain: NDArray[np.float32] | None = None) -> Picture:
        """The picture of Gaussians that were splatted.

        Args:
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


@dataclass(frozen=True)
class Blend:
    """How much of the memory's colours is taken."""

    share: float = 0.5  # weight of the memory's colours where both agree after the blur, 0 to 1
    # Difference of the blurred colours (0 to 1) at which the weight has fallen to 37 % (1/e) of
    # that.
    tolerance: float = 0.2


def blended(shown: Float32, memory: Float32, where: NDArray[np.bool_], *, blend: Blend) -> Float32:
    """(H, W, 3) blended colours in the pixels ``where``, the memory's elsewhere.

    Args:
        shown: (H, W, 3) colours of the Gaussians, 0 to 1.
        memory: (H, W, 3) colours of the memory, 0 to 1.
        where: (H, W) pixels that both know.
        blend: share and tolerance.

    >>> shown, everywhere = np.full((9, 9, 3), 0.5, np.float32), np.ones((9, 9), bool)
    >>> alike, unlike = shown + np.float32(0.02), shown + np.float32(0.4)
    >>> blend = Blend(share=1.0, tolerance=0.1)
    >>> round(float(blended(shown, alike, everywhere, blend=blend)[4, 4, 0]), 2)
    0.52
    >>> round(float(blended(shown, unlike, everywhere, blend=blend)[4, 4, 0]), 2)
    0.5
    """
    weight = blend.share * np.exp(-np.square(_difference(shown, memory, where) / blend.tolerance))
    mixed = shown + weight[..., None].astype(np.float32) * (memory - shown)
    return np.where(where[..., None], mixed, memory)


def best_blend(
    samples: Iterable[tuple[Float32, Float32, NDArray[np.bool_], Float32]],
    *,
    least_tolerance: float = 0.0,
) -> Blend:
    """The blend with the highest mean PSNR on photographs; the default without any sample.

    Args:
        samples: for each photograph (H, W, 3) colours of the Gaussians and of the memory, both made
            without it, (H, W) the pixels that both know, and (H, W, 3) the photograph; 0 to 1.
    """
    tolerances = [tolerance for tolerance in TOLERANCES if tolerance >= least_tolerance]
    choices = list(product(SHARES, tolerances))
    scores = np.zeros(len(choices))
    for shown, memory, where, truth in samples:
        if not where.any():
            continue
        apart = np.square(_difference(shown, memory, where)[where])
        off, detail = (shown - truth)[where], (memory - shown)[where]
        for number, (share, tolerance) in enumerate(choices):
            weight = share * np.exp(-apart / tolerance**2)
            scores[number] -= np.log10(np.square(off + weight[:, None] * detail).mean() + 1e-10)
    return Blend(*choices[int(scores.argmax())]) if scores.any() else Blend()


def _difference(shown: Float32, memory: Float32, where: NDArray[np.bool_]) -> Float32:
    """(H, W) greatest difference of the blurred colours over the pixels ``where``."""
    change = np.dstack([memory - shown, np.ones_like(where, np.float32)])
    change[~where] = 0
    blurred = cv2.GaussianBlur(change, (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE)
    red, green, blue, known = np.abs(blurred).transpose(2, 0, 1)
    most = np.maximum(np.maximum(red, green), blue)
    return np.asarray(most / np.maximum(known, np.float32(1e-3)))
