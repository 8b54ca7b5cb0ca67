"""Textures of procedural scenes: crops of photographs and generated patterns, varied and filtered.

Photographs are files that installed wheels hold, no download: scikit-image, which the project
needs, brings most; scikit-learn's two are used where that optional wheel is installed. The two
splits share no photograph, and the stereo pair of scikit-image, a sample of the project, is in
neither. Each texture is kept at halving resolutions in linear light, one row of texels after the
other, so that a kernel finds all textures of a scene in one array.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gvtools.kernels import compiled
from gvtools.optional import installed, package_folder
from gvtools.procedural.render import decode_srgb

# Names in skimage.data, and of scikit-learn's sample images ("sklearn:").
PHOTOGRAPHS = {
    "train": (
        "astronaut",
        "brick",
        "camera",
        "cell",
        "chelsea",
        "coins",
        "gravel",
        "hubble_deep_field",
        "immunohistochemistry",
        "page",
        "retina",
        "rocket",
        "sklearn:china",
    ),
    "held-out": ("clock", "coffee", "colorwheel", "grass", "moon", "text", "sklearn:flower"),
}
LONGEST = 512  # side that larger photographs are reduced to, pixels


def photograph_names(split: str) -> tuple[str, ...]:
    """The photographs of a split that are installed."""
    learn = installed("sklearn")
    return tuple(name for name in PHOTOGRAPHS[split] if learn or not name.startswith("sklearn:"))


@cache
def photograph(name: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 sRGB, at most ``LONGEST`` pixels a side."""
    if name.startswith("sklearn:"):
        package = package_folder("sklearn", extra="train", purpose=f"photograph {name!r}")
        file = package / "datasets" / "images" / f"{name[8:]}.jpg"
        image = Image.open(file).convert("RGB")
    else:
        import skimage.data

        image = Image.fromarray(np.asarray(getattr(skimage.data, name)())).convert("RGB")
    if max(image.size) > LONGEST:
        image.thumbnail((LONGEST, LONGEST), Image.Resampling.LANCZOS)
    return np.asarray(image)


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


def noise(rng: np.random.Generator, side: int) -> Float32:
    """(side, side) float32 in [0, 1]: value noise, each octave finer and weaker than the last."""
    cells = int(rng.integers(2, 9))  # along a side of the first octave
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
    image = Image.fromarray(photograph(photographs[int(rng.integers(len(photographs)))]))
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


def level_starts(side: int) -> NDArray[np.int64]:
    """(levels + 1,) where each level of a texture starts, and the number of all its texels."""
    sizes = [(side >> level) ** 2 for level in range(side.bit_length())]
    return np.cumsum([0, *sizes]).astype(np.int64)


def stack_levels(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
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
