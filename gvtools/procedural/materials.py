"""Textures of the furnished room, made of the photographs that the scikit-image wheel ships.

All are square, (SIDE, SIDE, 3) uint8 sRGB. The renderer repeats a texture in mirrored copies, so
none of them shows a seam. Nothing is downloaded.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from gvtools.procedural.photographs import photograph

Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]
Color = tuple[float, float, float]

SIDE = 256

# Photographs that hang on walls.
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


def picture(name: str) -> tuple[UInt8, float]:
    """A photograph to be shown once, and its width by its height."""
    image = photograph(name)
    return _resized(image), image.shape[1] / image.shape[0]


def globe(name: str) -> UInt8:
    """The middle of a photograph, to cover half a turn of a ball."""
    image = photograph(name)
    height, width = image.shape[:2]
    return _resized(image[height // 5 : -(height // 5), width // 5 : -(width // 5)])


def tiled(name: str, color: Color, *, contrast: float = 0.22, turned: bool = False) -> UInt8:
    """The relief of a photograph of a material in an sRGB tint.

    Args:
        name: of the photograph.
        color: sRGB in [0, 1], the mean.
        contrast: standard deviation of the brightness, share of the mean.
        turned: by 90 degrees.
    """
    relief = np.rot90(_relief(name)) if turned else _relief(name)
    return _tinted(1 + contrast * relief, color)


def paint(color: Color, *, grain: float = 0.05) -> UInt8:
    """Weak texture: one sRGB colour with a faint relief."""
    return tiled("gravel", color, contrast=grain)


def planks(color: Color, rng: np.random.Generator, *, rows: int = 8) -> UInt8:
    """Boards cut from the table under the cup of coffee, ``rows`` of them one above another."""
    from PIL import Image
    from scipy.ndimage import gaussian_filter

    # The grain of that table runs 32 degrees up to the right; this quadrilateral (upper left,
    # lower left, lower right, upper right) follows it beside the saucer.
    corners = (424, 120, 424, 340, 510, 285, 510, 66)
    wood = Image.fromarray(photograph("coffee")).transform(
        (128, 256), Image.Transform.QUAD, corners, Image.Resampling.BICUBIC
    )
    grey = np.asarray(wood).astype(np.float64).mean(-1)
    grain = 1 + 0.8 * (grey / gaussian_filter(grey, (12, 20), mode="mirror") - 1)
    boards = []
    for _ in range(rows):
        top = rng.integers(0, 256 - 60)
        strip = grain[top : top + 60][:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
        board = np.asarray(
            Image.fromarray(strip.astype(np.float32)).resize(
                (SIDE, SIDE // rows), Image.Resampling.BICUBIC
            )
        )
        board = board * rng.uniform(0.8, 1.15)
        joint = int(rng.integers(SIDE - 2))
        board[:, joint : joint + 2] *= 0.45
        board[-1:] *= 0.45
        boards.append(board)
    return _tinted(np.concatenate(boards), color)


def _resized(image: UInt8) -> UInt8:
    from PIL import Image

    whole = Image.fromarray(np.ascontiguousarray(image))
    return np.asarray(whole.resize((SIDE, SIDE), Image.Resampling.LANCZOS))


@cache
def _relief(name: str) -> Float64:
    """(SIDE, SIDE) grey photograph of mean 0 and deviation 1, slow gradients removed."""
    from scipy.ndimage import gaussian_filter

    grey = _resized(photograph(name)).astype(np.float64).mean(-1)
    grey = grey - gaussian_filter(grey, SIDE / 4, mode="mirror")
    return grey / grey.std()


def _tinted(factors: Float64, color: Color) -> UInt8:
    """An sRGB colour times (SIDE, SIDE) factors."""
    values = np.clip(factors, 0.1, 2)[..., None] * np.array(color) * 255
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
