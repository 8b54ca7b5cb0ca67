"""Generated textures in two tones: noise, stripes, checks, bricks, dots, gradients, plain paint."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

FIELDS = 16  # different fields of grain
GRAIN = np.float32(0.06)  # by which grain changes a pattern at most, share of its two tones


def pattern(rng: np.random.Generator, side: int) -> NDArray[np.uint8]:
    """(side, side, 3) uint8 sRGB: one of the generators, at random."""
    mask = _GENERATORS[rng.choice(len(_GENERATORS), p=_WEIGHTS)](rng, side)
    mask = mask + np.float32(rng.uniform(0, 2 * GRAIN)) * _grain(rng, side)
    first, second = color(rng), color(rng)
    if rng.random() < 0.5:
        # Tones of one paint: what most surfaces of a house look like.
        second = np.clip(first * rng.uniform(0.6, 1.3), 0, 1).astype(np.float32)
    steps = np.linspace(-GRAIN, 1 + GRAIN, 256, dtype=np.float32)[:, None]
    tones = np.clip(np.rint((first + steps * (second - first)) * 255), 0, 255).astype(np.uint8)
    return tones[((mask + GRAIN) * np.float32(255 / (1 + 2 * GRAIN))).astype(np.uint8)]


def color(rng: np.random.Generator) -> Float32:
    """(3,) float32 sRGB in [0, 1]; pale colours are more frequent than strong ones."""
    hue = rng.uniform(0, 6)
    saturation = 0.75 * rng.beta(1.2, 2.2)
    value = rng.uniform(0.2, 0.97)
    ramp = np.clip(np.abs((hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return (value * (1 - saturation * (1 - ramp))).astype(np.float32)


def noise(rng: np.random.Generator, side: int, *, coarsest: int | None = None) -> Float32:
    """(side, side) float32 in [0, 1]: value noise, each octave finer and weaker than the last.

    Args:
        rng: decides octaves and values.
        side: pixels.
        coarsest: cells along a side of the first octave; None draws it.
    """
    from PIL import Image

    cells = int(rng.integers(2, 9)) if coarsest is None else coarsest
    persistence = rng.uniform(0.35, 0.75)
    total = np.zeros((side, side), np.float32)
    weight = 1.0
    while weight > 0.1 and cells < side:
        grid = Image.fromarray(rng.random((cells, cells), np.float32))
        smooth = np.asarray(grid.resize((side, side), Image.Resampling.BICUBIC))
        total += np.float32(weight) * smooth
        weight *= persistence
        cells *= 2
    low, high = float(total.min()), float(total.max())
    return (total - np.float32(low)) / np.float32(max(high - low, 1e-6))


def _grain(rng: np.random.Generator, side: int) -> Float32:
    """(side, side) float32 in [-0.5, 0.5]: one of a few fields, mirrored and rolled."""
    field = _fields(side)[rng.integers(FIELDS)][:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
    return np.roll(field, rng.integers(0, side, 2), axis=(0, 1))


@cache
def _fields(side: int) -> tuple[Float32, ...]:
    rng = np.random.default_rng(0)
    return tuple(noise(rng, side) - np.float32(0.5) for _ in range(FIELDS))


@cache
def _coordinates(side: int) -> tuple[Float32, Float32]:
    x = (np.arange(side, dtype=np.float32) + np.float32(0.5)) / np.float32(side)
    y, x = np.meshgrid(x, x, indexing="ij")
    return x, y


def _turned(rng: np.random.Generator, side: int) -> tuple[Float32, Float32]:
    """Coordinates in [0, 1], turned by one of a few angles."""
    angle = rng.choice([0.0, 0.0, 0.5, 0.25, rng.uniform(0, 1)]) * np.pi
    x, y = _coordinates(side)
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return c * x + s * y, c * y - s * x


def _stripes(rng: np.random.Generator, side: int) -> Float32:
    x, _ = _turned(rng, side)
    phase = (x * np.float32(rng.uniform(2, 16))) % np.float32(1)
    if rng.random() < 0.3:
        return np.abs(2 * phase - 1)
    return (phase < rng.uniform(0.15, 0.85)).astype(np.float32)


def _checks(rng: np.random.Generator, side: int) -> Float32:
    x, y = _turned(rng, side)
    count = rng.uniform(2, 10)
    rows = np.floor(y * np.float32(count * rng.choice([1, 1, 0.5])))
    return (np.floor(x * np.float32(count)) + rows) % np.float32(2)


def _bricks(rng: np.random.Generator, side: int) -> Float32:
    """Bricks, tiles or boards with joints; each stone has its own tone."""
    x, y = _coordinates(side)
    if rng.random() < 0.3:
        x, y = y, x
    rows, columns = int(rng.integers(3, 13)), int(rng.integers(1, 7))
    offset = rng.choice([0.5, 0.0, rng.uniform(0, 1)])
    v = y * np.float32(rows)
    row = np.floor(v)
    u = x * np.float32(columns) + np.float32(offset) * (row % 2)
    column = np.floor(u)
    joint = rng.uniform(0.02, 0.1)
    inside = (v - row > joint) & (u - column > joint * columns / rows)
    tone = rng.uniform(1 - rng.uniform(0.1, 0.6), 1, (rows, columns + 1)).astype(np.float32)
    return np.where(inside, tone[row.astype(int), column.astype(int)], np.float32(0))


def _dots(rng: np.random.Generator, side: int) -> Float32:
    x, y = _turned(rng, side)
    count, radius = np.float32(rng.uniform(3, 12)), rng.uniform(0.2, 0.42)
    u, v = (x * count) % 1 - np.float32(0.5), (y * count) % 1 - np.float32(0.5)
    return (u * u + v * v < radius**2).astype(np.float32)


def _gradient(rng: np.random.Generator, side: int) -> Float32:
    x, y = _turned(rng, side)
    ramp = x + np.float32(rng.uniform(-0.3, 0.3)) * y
    return (ramp - ramp.min()) / np.float32(np.ptp(ramp))


def _plain(rng: np.random.Generator, side: int) -> Float32:
    return np.full((side, side), rng.random(), np.float32)


_GENERATORS: tuple[Callable[[np.random.Generator, int], Float32], ...] = (
    noise,
    _stripes,
    _checks,
    _bricks,
    _dots,
    _gradient,
    _plain,
)
_WEIGHTS = (0.3, 0.1, 0.08, 0.17, 0.05, 0.1, 0.2)
