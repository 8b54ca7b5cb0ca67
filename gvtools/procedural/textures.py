"""Textures of procedural scenes: crops of photographs and generated patterns, varied and filtered.

Each is kept at halving resolutions, in linear light.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.procedural.color import decode_srgb
from gvtools.procedural.patterns import color, pattern
from gvtools.procedural.photographs import photograph

if TYPE_CHECKING:
    from PIL.Image import Image

SIDE = 128  # texels along a side of a training scene's finest level
PHOTOGRAPH_SHARE = 0.5


def texture(rng: np.random.Generator, photographs: Sequence[str]) -> NDArray[np.uint8]:
    """(SIDE, SIDE, 3) uint8 sRGB: a varied photograph, or a generated pattern."""
    if photographs and rng.random() < PHOTOGRAPH_SHARE:
        return picture(rng, photographs)
    return pattern(rng, SIDE)


def picture(rng: np.random.Generator, photographs: Sequence[str]) -> NDArray[np.uint8]:
    """(SIDE, SIDE, 3) uint8 sRGB: a crop of one of the named photographs, varied.

    The crop has a quarter to all of the shorter side and an aspect of 0.7 to 1.4; it is mirrored,
    turned by 90 degrees, its channels are exchanged; dark ones are lifted; contrast, gains and tint
    are changed.
    """
    from PIL import Image

    image = _image(photographs[int(rng.integers(len(photographs)))])
    shorter = min(image.size)
    height = shorter * np.exp(rng.uniform(np.log(0.25), 0))
    width = min(height * rng.uniform(0.7, 1.4), image.size[0])
    left = rng.uniform(0, image.size[0] - width)
    top = rng.uniform(0, image.size[1] - height)
    box = (left, top, left + width, top + height)
    crop = np.asarray(image.resize((SIDE, SIDE), Image.Resampling.BILINEAR, box=box))
    if rng.random() < 0.5:
        crop = crop[:, ::-1]
    if rng.random() < 0.2:
        crop = crop.transpose(1, 0, 2)
    if rng.random() < 0.5:
        crop = crop[..., rng.permutation(3)]
    return _recoloured(crop, rng)


def _recoloured(crop: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Another contrast, brightness, gain a channel and, now and then, a tint."""
    steps = np.arange(256, dtype=np.float32)[:, None] / np.float32(255)
    middle = float(crop[::8, ::8].mean() / 255)
    contrast, brightness = rng.uniform(0.6, 1.3), rng.uniform(0.8, 1.3)
    brightness *= np.clip(0.3 / max(middle, 0.05), 1, 3)
    gain = rng.uniform(0.85, 1.15, 3).astype(np.float32)
    table = ((steps - np.float32(middle)) * np.float32(contrast) + np.float32(middle)) * gain
    table *= np.float32(brightness)
    if rng.random() < 0.3:
        share = np.float32(rng.uniform(0.1, 0.5))
        table = (1 - share) * table + share * color(rng)
    table = np.clip(np.rint(table * 255), 0, 255).astype(np.uint8)
    return np.stack([table[crop[..., channel], channel] for channel in range(3)], axis=-1)


@cache
def _image(name: str) -> Image:
    from PIL import Image

    return Image.fromarray(photograph(name))


def stacked(images: Sequence[NDArray[np.uint8]]) -> tuple[NDArray[np.float32], ...]:
    """(T, S, S, 3) float32 linear light of every texture, and its 2 x 2 means down to one texel.

    Textures are square, of one size, and their side is a power of two.
    """
    levels = [decode_srgb(np.stack(images))]
    while levels[-1].shape[1] > 1:
        count, side = levels[-1].shape[:2]
        levels.append(levels[-1].reshape(count, side // 2, 2, side // 2, 2, 3).mean((2, 4)))
    return tuple(levels)
