"""Textures of procedural scenes: crops of photographs and generated patterns, varied and filtered.

Each is kept at halving resolutions in linear light, one row of texels after the other, so that a
kernel finds all textures of a scene in one array.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled
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


def level_starts(side: int) -> NDArray[np.int64]:
    """(levels + 1,) where each level of a texture starts, and the number of all its texels."""
    sizes = [(side >> level) ** 2 for level in range(side.bit_length())]
    return np.cumsum([0, *sizes]).astype(np.int64)


def stacked(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """(T, texels, 3) float32 linear light: every texture at all its levels, row by row.

    Textures are square, of one size, and their side is a power of two.
    """
    encoded = np.stack(images)
    out = np.empty((len(encoded), level_starts(encoded.shape[1])[-1], 3), np.float32)
    _fill(encoded, decode_srgb(np.arange(256, dtype=np.uint8)), out)
    return out


@compiled()
def _fill(encoded, linear, out):
    """Decode the finest level, then average 2 x 2 texels of each level for the next."""
    count, side = encoded.shape[:2]
    for t in range(count):
        for row in range(side):
            for col in range(side):
                for c in range(3):
                    out[t, row * side + col, c] = linear[encoded[t, row, col, c]]
        above = 0
        start = side * side
        half = side // 2
        while half:
            for row in range(half):
                for col in range(half):
                    first = above + 4 * row * half + 2 * col
                    below = first + 2 * half
                    for c in range(3):
                        total = out[t, first, c] + out[t, first + 1, c]
                        total += out[t, below, c] + out[t, below + 1, c]
                        out[t, start + row * half + col, c] = np.float32(0.25) * total
            above = start
            start += half * half
            half //= 2
