"""Colours from Gaussians and memory together: each is wrong where the other need not be.

Gaussians are smooth and rarely far off; the memory is sharp, and far off where depth was wrong. Its
detail is added where both agree once blurred.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from skimage.filters import gaussian

Float32 = NDArray[np.float32]

# Standard deviation of the blur [px].
BLUR = 3.0
# What is tried for the share and the tolerance.
SHARES, TOLERANCES = (0.0, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0), (0.05, 0.1, 0.2, 0.4, 1.0, 4.0)


@dataclass(frozen=True)
class Blend:
    """How much of the memory's colours is taken.

    Attributes:
        share: where both agree, 0 to 1.
        tolerance: difference after blurring, of colours 0 to 1, at which it is down to 37 %.
    """

    share: float = 0.5
    tolerance: float = 0.2


def blended(shown: Float32, memory: Float32, where: NDArray[np.bool_], *, blend: Blend) -> Float32:
    """(H, W, 3) colours of both in the pixels ``where``, the memory's elsewhere.

    Args:
        shown: (H, W, 3) colours of the Gaussians, 0 to 1.
        memory: (H, W, 3) colours of the memory, 0 to 1.
        where: (H, W) pixels that both know.
        blend: how.

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
    """The blend that comes nearest to photographs, by mean PSNR; the default if none tells.

    Args:
        samples: of each photograph the colours of the Gaussians and of the memory, neither of which
            has seen it, the pixels that both know, and the photograph, 0 to 1.
        least_tolerance: smaller tolerances are not tried.
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
    known = where.astype(np.float32)
    change = gaussian(np.where(where[..., None], memory - shown, 0), BLUR, channel_axis=2)
    return np.abs(change).max(axis=2) / np.maximum(gaussian(known, BLUR), np.float32(1e-3))
