"""Photographs that the scikit-image wheel ships, made into filtered textures for walls and things.

Only files inside the wheel are used, so nothing is downloaded. Colours are linear light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

SIDE = 512  # texels along a picture or a tile at the finest level

# Photographs that hang on walls, by their names in skimage.data.
PICTURES = (
    "astronaut",
    "chelsea",
    "coffee",
    "camera",
    "coins",
    "colorwheel",
    "hubble_deep_field",
    "immunohistochemistry",
    "moon",
    "page",
    "retina",
)


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture at halving resolutions.

    Attributes:
        levels: (h, w, 3) float32 linear light, each half the one before; sides are powers of two.
        repeats: whether it tiles the plane; otherwise its border is continued.
        aspect: width by height of what it shows.
    """

    levels: tuple[Float32, ...]
    repeats: bool
    aspect: float

    def sample(self, u: Float64, v: Float64, texels: Float64) -> Float32:
        """(N, 3) colours at (N,) places, in tiles; ``texels``: the side that a sample covers."""
        # Two neighbouring levels are mixed, or views at different distances would disagree.
        level = np.clip(np.log2(np.maximum(texels, 1e-6)), 0, len(self.levels) - 1)
        fine = np.minimum(level.astype(np.intp), len(self.levels) - 2)
        mix = (level - fine).astype(np.float32)[:, None]
        color = np.empty((len(u), 3), np.float32)
        for index in np.unique(fine):
            rows = np.flatnonzero(fine == index)
            near = self._bilinear(self.levels[index], u[rows], v[rows])
            far = self._bilinear(self.levels[index + 1], u[rows], v[rows])
            color[rows] = near + (far - near) * mix[rows]
        return color

    def _bilinear(self, image: Float32, u: Float64, v: Float64) -> Float32:
        height, width = image.shape[:2]
        x, y = u * width - 0.5, v * height - 0.5
        left, top = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
        fx = (x - left).astype(np.float32)[:, None]
        fy = (y - top).astype(np.float32)[:, None]
        texels = image.reshape(-1, 3)
        if self.repeats:
            columns = [(left + i) & (width - 1) for i in (0, 1)]
            rows = [((top + i) & (height - 1)) * width for i in (0, 1)]
        else:
            columns = [np.clip(left + i, 0, width - 1) for i in (0, 1)]
            rows = [np.clip(top + i, 0, height - 1) * width for i in (0, 1)]
        upper, lower = (
            texels[row + columns[0]] * (1 - fx) + texels[row + columns[1]] * fx for row in rows
        )
        return upper * (1 - fy) + lower * fy


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


def average_blocks(image: Float32, side: int) -> Float32:
    """(h / side, w / side, C) means of ``side`` x ``side`` pixels."""
    parts = [image[i::side, j::side] for i in range(side) for j in range(side)]
    return np.add.reduce(parts) / np.float32(len(parts))


@cache
def photograph(name: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8, a photograph of ``skimage.data`` by its function's name."""
    import skimage.data

    image = np.asarray(getattr(skimage.data, name)())
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3])


def picture(name: str) -> Texture:
    """A photograph to be shown once."""
    image = photograph(name)
    aspect = image.shape[1] / image.shape[0]
    return _pyramid(_resized(image, SIDE, SIDE), repeats=False, aspect=aspect)


def globe(name: str) -> Texture:
    """A photograph wrapped round a ball without a seam; the ball shows the tile's upper half."""
    image = photograph(name)
    height, width = image.shape[:2]
    image = image[height // 5 : -(height // 5), width // 5 : -(width // 5)]
    half = _resized(image, SIDE // 2, SIDE // 2)
    return _pyramid(_mirrored(half), repeats=True, aspect=2)


def paint(color: tuple[float, float, float], *, grain: float = 0.05, of: str = "gravel") -> Texture:
    """Weak texture: one sRGB colour with the faint relief of a photograph."""
    relief = _contrast(_relief(of), grain)
    return _pyramid(_mirrored(_tinted(relief, color)), repeats=True, aspect=1)


def tiled(
    name: str, color: tuple[float, float, float], *, contrast: float = 1.0, turned: bool = False
) -> Texture:
    """A photograph of a material, mirrored so that it tiles without seams, in an sRGB tint."""
    relief = _relief(name)
    relief = _contrast(np.rot90(relief) if turned else relief, 0.22 * contrast)
    return _pyramid(_mirrored(_tinted(relief, color)), repeats=True, aspect=1)


def planks(
    color: tuple[float, float, float], rng: np.random.Generator, *, rows: int = 8
) -> Texture:
    """Boards cut from the table under the cup of coffee; one tile is ``rows`` boards high."""
    from PIL import Image
    from scipy.ndimage import gaussian_filter

    # The grain of that table runs 32 degrees up to the right; this quadrilateral (upper left,
    # lower left, lower right, upper right) follows it beside the saucer.
    corners = (497, 141, 497, 398, 598, 334, 598, 77)
    wood = Image.fromarray(photograph("coffee")).transform(
        (128, 256), Image.Transform.QUAD, corners, Image.Resampling.BICUBIC
    )
    grey = np.asarray(wood).astype(np.float64).mean(-1)
    grain = 1 + 0.8 * (grey / gaussian_filter(grey, (12, 20), mode="mirror") - 1)
    thickness = SIDE // rows
    boards = []
    for _ in range(rows):
        top = rng.integers(0, 256 - 60)
        strip = grain[top : top + 60][:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
        half = np.asarray(
            Image.fromarray(strip.astype(np.float32)).resize(
                (SIDE // 2, thickness), Image.Resampling.BICUBIC
            )
        )
        board = np.concatenate([half, half[:, ::-1]], axis=1) * rng.uniform(0.8, 1.15)
        board = np.roll(board, int(rng.integers(SIDE)), axis=1)
        joint = int(rng.integers(SIDE - 3))
        board[:, joint : joint + 3] *= 0.45
        board[-2:] *= 0.45
        boards.append(board)
    return _pyramid(_tinted(np.concatenate(boards)[..., None], color), repeats=True, aspect=1)


def _resized(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(image))
    return np.asarray(picture.resize((width, height), Image.Resampling.LANCZOS))


@cache
def _relief(name: str) -> Float64:
    """(h, w) grey photograph of mean 0 and standard deviation 1, slow gradients removed."""
    from scipy.ndimage import gaussian_filter

    grey = _resized(photograph(name), SIDE // 2, SIDE // 2).astype(np.float64).mean(-1)
    grey = grey - gaussian_filter(grey, SIDE / 8, mode="mirror")
    return grey / grey.std()


def _contrast(relief: Float64, amount: float) -> Float64:
    """(h, w, 1) factors of mean 1 and standard deviation ``amount``."""
    return np.clip(1 + amount * relief, 0.1, 2)[..., None]


def _tinted(relief: Float64, color: tuple[float, float, float]) -> NDArray[np.uint8]:
    return np.clip(np.rint(relief * np.array(color) * 255), 0, 255).astype(np.uint8)


def _mirrored(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    wide = np.concatenate([image, image[:, ::-1]], axis=1)
    return np.concatenate([wide, wide[::-1]], axis=0)


def _pyramid(image: NDArray[np.uint8], *, repeats: bool, aspect: float) -> Texture:
    levels = [decode_srgb(image)]
    while min(levels[-1].shape[:2]) > 1:
        levels.append(average_blocks(levels[-1], 2))
    return Texture(tuple(levels), repeats, aspect)
