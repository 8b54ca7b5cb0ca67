"""Gaussians as the page's renderer keeps them: arrays of 32-bit words, four a Gaussian.

The layout is that of Spark's ``ExtSplats``: positions in single precision, opacities, colours and
logarithms of sizes in half precision, rotations in 32 bits, and of harmonics above degree 0 three
8-bit magnitudes with one exponent and three signs. Spark's own reader of PLYs takes the exponent
one too small and cuts coefficients off, which costs 0.3 dB; here it is the right one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.project_kernels import HARMONICS

# Arrays of harmonics: which coefficients above degree 0 each holds, by the degree that needs it.
PARTS = ((0, 4), (4, 8), (8, 12), (12, 15))
PARTS_OF_DEGREE = (0, 1, 2, 4)
# Steps of a rotation's axis and angle, and of a coefficient; what exponents are counted from.
AXIS, ANGLE, MAGNITUDE, BIAS = 1023, 4095, 255, 15
# The largest number in half precision.
MOST = 65504.0

Float32 = NDArray[np.float32]
Words = NDArray[np.uint32]


def pack_gaussians(
    positions: Float32,
    *,
    log_scales: Float32,
    quaternions: Float32,
    logits: Float32,
    harmonics: Float32,
) -> list[Words]:
    """Two arrays (N, 4), and as many for harmonics (N, H, 3) as their degree needs.

    Quaternions are w, x, y, z of length 1, opacities before the sigmoid.
    """
    opacity = 1 / (1 + np.exp(-logits.astype(np.float64)))
    color = 0.5 + HARMONICS[0] * harmonics[:, 0]
    numbers = np.concatenate([color, log_scales], axis=1).clip(-MOST, MOST)
    halves = numbers.astype("<f2").view("<u2").astype(np.uint32)
    first = np.empty((len(positions), 4), np.uint32)
    first[:, :3] = positions.astype("<f4").view("<u4")
    first[:, 3] = opacity.astype("<f2").view("<u2")
    second = np.empty_like(first)
    second[:, :3] = halves[:, ::2] | halves[:, 1::2] << 16
    second[:, 3] = _turns(quaternions)
    above = _shared_exponents(harmonics[:, 1:])
    degree = round(harmonics.shape[1] ** 0.5) - 1
    rest = []
    for start, stop in PARTS[: PARTS_OF_DEGREE[degree]]:
        part = np.zeros_like(first)
        part[:, : above[:, start:stop].shape[1]] = above[:, start:stop]
        rest.append(part)
    return [first, second, *rest]


def _turns(quaternions: Float32) -> Words:
    """(N,) axes by an octahedron, 10 bits each of two numbers, and 12 bits of the angle."""
    q = quaternions.astype(np.float64)
    q = np.where(q[:, :1] < 0, -q, q)
    length = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    axis = np.where(length > 0, q[:, 1:] / np.where(length > 0, length, 1), (1.0, 0.0, 0.0))
    x, y, z = (axis / np.abs(axis).sum(axis=1, keepdims=True)).T
    # The lower half is folded outwards.
    u = np.where(z < 0, (1 - np.abs(y)) * np.where(x >= 0, 1, -1), x)
    v = np.where(z < 0, (1 - np.abs(x)) * np.where(y >= 0, 1, -1), y)
    angle = 2 * np.arctan2(length[:, 0], q[:, 0])
    steps = [
        np.rint(AXIS * (u + 1) / 2),
        np.rint(AXIS * (v + 1) / 2),
        np.rint(ANGLE * angle / np.pi),
    ]
    low, middle, high = (step.astype(np.uint32) for step in steps)
    return low | middle << 10 | high << 20


def _shared_exponents(coefficients: Float32) -> Words:
    """(N, K) of coefficients (N, K, 3)."""
    size = np.abs(coefficients.astype(np.float64))
    # 2 to this power is above the largest of the three.
    power = np.clip(np.frexp(size.max(axis=2))[1], -BIAS, 31 - BIAS)
    steps = np.minimum(np.rint(MAGNITUDE * np.ldexp(size, -power[..., None])), MAGNITUDE)
    red, green, blue = np.moveaxis(steps.astype(np.uint32), 2, 0)
    signs = (coefficients < 0).astype(np.uint32) << np.arange(3, dtype=np.uint32)
    exponents = (power + BIAS).astype(np.uint32) << 3 | signs.sum(axis=2, dtype=np.uint32)
    return red | green << 8 | blue << 16 | exponents << 24
