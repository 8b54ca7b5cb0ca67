"""8-bit sRGB and linear light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


def decode_srgb(encoded: NDArray[np.uint8]) -> Float32:
    """Linear light in [0, 1] of 8-bit sRGB."""
    value = np.arange(256) / 255
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[encoded]


def encode_srgb(linear: Float32) -> NDArray[np.uint8]:
    """8-bit sRGB of linear light; the brightest tenth is rolled off instead of cut."""
    knee = np.float32(0.7)
    over = np.maximum(linear - knee, 0)
    value = np.minimum(linear, knee) + (1 - knee) * (1 - np.exp(-over / (1 - knee)))
    value = np.clip(value, 0, 1)
    value = np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.rint(value * 255).astype(np.uint8)
