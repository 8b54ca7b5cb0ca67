"""A contact sheet of several methods: truth, pictures, and error maps, a row of tiles a view.

What the context never observed is outlined on the error maps; below the truth stands the truth with
everything else dimmed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ShapeError
from viz.plots.palette import SKY
from viz.report.contact_sheet import WORST, error_map

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

SIDE = 320  # a tile's longer edge, pixels
GAP = 6
LETTERS = 15
BACKGROUND, INK = (255, 255, 255), (20, 20, 20)
MISSING = (200, 200, 200)
DIM = 0.2  # of the brightness is left where the context observed
RIM = 5  # pixels of the square that thins a region to its outline: two on either side


@dataclass(frozen=True, eq=False)
class JudgedView:
    """One view with the pictures that methods made of it.

    Attributes:
        name: of the view.
        truth: (H, W, 3) uint8; None where there is none.
        mask: (H, W) bool, where the truth counts; None is everywhere.
        never_observed: (H, W) bool, what the context never observed.
        pictures: by method, (H, W, 3) uint8; None where the method has none of this view.
    """

    name: str
    truth: NDArray[np.uint8] | None
    mask: NDArray[np.bool_] | None
    never_observed: NDArray[np.bool_]
    pictures: Mapping[str, NDArray[np.uint8] | None]


def sheet(views: Sequence[JudgedView]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8: for each view a line of pictures, and a line of error maps below.

    Args:
        views: at least one, all with the same methods.
    """
    from PIL import Image, ImageDraw

    if not views:
        raise ShapeError("a contact sheet of no views; expected at least one")
    methods = tuple(views[0].pictures)
    blocks = [_block(view, methods) for view in views]
    width = max(block.width for block in blocks)
    canvas = Image.new(
        "RGB", (width, sum(block.height for block in blocks) + LETTERS * 2), BACKGROUND
    )
    top = 0
    for block in blocks:
        canvas.paste(block, (0, top))
        top += block.height
    text = (
        f"error maps: mean absolute difference over the channels, black 0 to bright {WORST:.0%} of "
        "the range; bright below the truth, outlined on error maps: never observed by the context; "
        "numbers: PSNR, dB"
    )
    ImageDraw.Draw(canvas).text((GAP, top + 2), text, INK, font=_font(LETTERS - 3))
    return np.asarray(canvas)


def _block(view: JudgedView, methods: Sequence[str]) -> Image:
    """The tiles of one view: truth and pictures, and error maps below where there is a truth."""
    from PIL import Image, ImageDraw

    size = _tile_size(view.never_observed.shape)
    lines = 1 if view.truth is None else 2
    step = size[0] + GAP
    block = Image.new(
        "RGB",
        (GAP + step * (len(methods) + 1), lines * (size[1] + GAP) + LETTERS + 2 * GAP),
        BACKGROUND,
    )
    draw, font = ImageDraw.Draw(block), _font(LETTERS - 2)
    first = [view.truth, *(view.pictures[method] for method in methods)]
    second = [_dimmed(view), *(_error(view, method) for method in methods)]
    heads = [f"{view.name}, truth" if view.truth is not None else view.name]
    heads += [_heading(view, method) for method in methods]
    for column, head in enumerate(heads):
        left, top = GAP + column * step, LETTERS + GAP
        draw.text((left, GAP // 2), _cut(head, draw, font=font, width=size[0]), INK, font=font)
        block.paste(_tile(first[column], size), (left, top))
        if lines == 2:
            outlined = view.never_observed if column else None
            block.paste(_tile(second[column], size, outlined), (left, top + size[1] + GAP))
    return block


def _dimmed(view: JudgedView) -> NDArray[np.uint8] | None:
    """The truth, dark where the context observed it."""
    if view.truth is None:
        return None
    share = np.where(view.never_observed, 1.0, DIM)[..., None]
    return np.rint(view.truth * share).astype(np.uint8)


def _error(view: JudgedView, method: str) -> NDArray[np.uint8] | None:
    picture = view.pictures[method]
    if picture is None or view.truth is None:
        return None
    return error_map(picture, view.truth, mask=view.mask)


def _heading(view: JudgedView, method: str) -> str:
    from gvtools.evaluation.images import psnr

    picture = view.pictures[method]
    if picture is None:
        return f"{method}: no picture"
    if view.truth is None:
        return method
    value = psnr(picture, view.truth, mask=view.mask)
    return method if value is None else f"{method}: {value:.2f}"


def _tile(
    picture: NDArray[np.uint8] | None,
    size: tuple[int, int],
    outlined: NDArray[np.bool_] | None = None,
) -> Image:
    """A thumbnail, grey where there is no picture, with the outline of a region."""
    from PIL import Image

    if picture is None:
        return Image.new("RGB", size, MISSING)
    small = Image.fromarray(picture).resize(size, Image.Resampling.BOX)
    if outlined is None or not outlined.any():
        return small
    pixels = np.array(small)
    pixels[_outline(outlined, size)] = [int(SKY[i : i + 2], 16) for i in (1, 3, 5)]
    return Image.fromarray(pixels)


def _outline(region: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """(h, w) bool: the inner rim of what covers at least half of a thumbnail's pixel."""
    import cv2

    share = cv2.resize(region.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    inside = (share >= 0.5).astype(np.uint8)
    rim = inside - cv2.erode(inside, np.ones((RIM, RIM), np.uint8), borderValue=1)
    return np.asarray(rim, np.bool_)


def _tile_size(shape: tuple[int, ...]) -> tuple[int, int]:
    height, width = shape[:2]
    scale = min(SIDE / max(height, width), 1.0)
    return max(round(width * scale), 1), max(round(height * scale), 1)


def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _cut(text: str, draw: ImageDraw, *, font: Any, width: int) -> str:
    """The text, its beginning left out where it is wider than the tile."""
    while len(text) > 4 and draw.textlength(text, font=font) > width:
        text = "…" + text[2:]
    return text
