"""The pictures of a camera side by side, as the web viewer shows them."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError
from viz.run_view.view import CONTEXT, TARGET, TRUTH, RunView, ShownCamera
from viz.web.cameras import thumbnail

# Of the pictures that stand side by side, in order.
SHOWN = ("guidance", "completion", TRUTH)
PICTURE_SIDE = 640
# Of the row of pictures at least, pixels.
ROW_WIDTH = 760
GAP = 8


@dataclass(frozen=True, eq=False)
class ShownPictures:
    """What there is to see of a camera.

    Attributes:
        title: HTML, what it is of and what is not there.
        names: of the pictures, left to right, "" where there is none.
        row: (H, W, 3) uint8, the pictures side by side; None where there are none.
    """

    title: str
    names: tuple[str, ...]
    row: NDArray[np.uint8] | None


def shown_pictures(run: RunView, shown: ShownCamera) -> ShownPictures:
    """Read the pictures of a camera; what cannot be read is said in the title."""
    title = f"<b>{escape(shown.name)}</b>, {shown.kind}, round {shown.round}"
    if shown.coverage is not None:
        before, after = (f"{100 * share:.1f} %" for share in shown.coverage)
        title += f", coverage {before} before the round, {after} after it"
    try:
        pictures = run.pictures(shown)
    except GvError as error:
        pictures = {}
        title += f"<br>{escape(str(error))}"
    there = [name for name in SHOWN if name in pictures]
    absent = [name for name in SHOWN if name not in pictures and shown.kind == TARGET]
    if absent:
        title += f"<br>not there: {', '.join(absent)}"
    names = {TRUTH: "given picture"} if shown.kind == CONTEXT else {}
    padded = (*(names.get(name, name) for name in there), *[""] * (len(SHOWN) - len(there)))
    row = side_by_side([pictures[name] for name in there]) if there else None
    return ShownPictures(title, padded, row)


def side_by_side(pictures: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Up to three pictures (H, W, 3) in a row of three, as high as the first.

    Small ones are enlarged by a whole factor, so that the row fills its panel.
    """
    small = [thumbnail(picture, PICTURE_SIDE) for picture in pictures]
    factor = -(-ROW_WIDTH // (len(SHOWN) * small[0].shape[1]))
    first = small[0].repeat(factor, axis=0).repeat(factor, axis=1)
    height = len(first)
    cells = [first, *(_of_height(picture, height) for picture in small[1:])]
    cells += [np.full_like(first, 255)] * (len(SHOWN) - len(cells))
    gap = np.full((height, GAP, 3), 255, np.uint8)
    return np.concatenate([part for cell in cells for part in (cell, gap)][:-1], axis=1)


def _of_height(picture: NDArray[np.uint8], height: int) -> NDArray[np.uint8]:
    from PIL import Image

    width = max(1, round(picture.shape[1] * height / picture.shape[0]))
    return np.array(Image.fromarray(picture).resize((width, height), Image.Resampling.NEAREST))
