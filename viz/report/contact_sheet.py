"""Contact sheets: for each target what was given, what was made of it, and how far it is off.

The pictures of a target are small files of their own, which a page lays out as its width allows.
"""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ShapeError
from viz.plots.palette import BLUE, GREEN, ORANGE

# Longer side of a thumbnail, pixels: twice what a phone shows of it, for its dense screen.
SIDE = 320
QUALITY = 80
# Mean absolute difference over the channels, of a range of 1, at which an error map is brightest.
WORST = 0.25
ERROR_MAP = "inferno"
# Of the validity: what stands on observations, on a scan's alone, on what was generated before, on
# nothing.
SUPPORT = {"observed": BLUE, "scanned": GREEN, "generated": ORANGE, "hole": "#1a1a1a"}


@dataclass(frozen=True)
class Tile:
    """One thumbnail.

    Attributes:
        label: what it shows.
        alt: the same in a sentence, for those who cannot see it.
        uri: the picture as a data URI.
        width: pixels.
        height: pixels.
    """

    label: str
    alt: str
    uri: str
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class TargetPictures:
    """What a target's row of a contact sheet is made of; all of one size but the context.

    Attributes:
        name: of the target.
        hint: (H, W, 3) uint8, the memory's projection that the completer was given.
        observed: (H, W) bool, pixels of the hint that stand on observations, a scan's included.
        supported: (H, W) bool, those that the memory supports at all.
        completion: (H, W, 3) uint8.
        truth: (H, W, 3) uint8; None where there is none.
        mask: (H, W) bool, where the truth counts; None is everywhere.
        context: (h, w, 3) uint8, the given view nearest to the target; None where it is not there.
        context_name: of that view.
        scanned: (H, W) bool, those of the observed pixels that are a scan's alone; None: none are.
    """

    name: str
    hint: NDArray[np.uint8]
    observed: NDArray[np.bool_]
    supported: NDArray[np.bool_]
    completion: NDArray[np.uint8]
    truth: NDArray[np.uint8] | None = None
    mask: NDArray[np.bool_] | None = None
    context: NDArray[np.uint8] | None = None
    context_name: str = ""
    scanned: NDArray[np.bool_] | None = None


def contact_row(pictures: TargetPictures, *, side: int = SIDE) -> list[Tile]:
    """Context, hint, validity, completion, truth and error map, as far as there are pictures.

    Args:
        pictures: of one target.
        side: of a thumbnail's longer edge, pixels; smaller pictures keep their size.
    """
    name = pictures.name
    tiles = []
    if pictures.context is not None:
        text = f"context view {pictures.context_name}, the nearest to {name}"
        tiles.append(_tile("context", text, _photograph(pictures.context, side)))
    text = f"the memory projected into {name}"
    tiles.append(_tile("hint", text, _photograph(pictures.hint, side)))
    validity = support_map(pictures.observed, pictures.supported, pictures.scanned)
    scanned = "" if pictures.scanned is None else f"{pictures.scanned.mean():.0%} of it scanned, "
    text = (
        f"validity of {name}: {pictures.observed.mean():.0%} observed, {scanned}"
        f"{(pictures.supported & ~pictures.observed).mean():.0%} generated before"
    )
    tiles.append(_tile("validity", text, _flat_colours(validity, side)))
    text = f"completed picture of {name}"
    tiles.append(_tile("completion", text, _photograph(pictures.completion, side)))
    if pictures.truth is not None:
        tiles.append(_tile("truth", f"photograph {name}", _photograph(pictures.truth, side)))
        error = error_map(pictures.completion, pictures.truth, mask=pictures.mask)
        tiles.append(_tile("error", f"error map of {name}", _photograph(error, side)))
    return tiles


def support_map(
    observed: NDArray[np.bool_],
    supported: NDArray[np.bool_],
    scanned: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
    """(H, W, 3): the colours of SUPPORT.

    Args:
        observed: (H, W), what stands on observations.
        supported: (H, W), what the memory supports, observed or generated.
        scanned: (H, W), what of the observed is a scan's alone; None is nothing.
    """
    which = np.where(observed, 0, np.where(supported, 2, 3))
    if scanned is not None:
        which[scanned] = 1
    colors = [[int(color[i : i + 2], 16) for i in (1, 3, 5)] for color in SUPPORT.values()]
    return np.array(colors, np.uint8)[which]


def error_map(
    picture: NDArray[np.uint8], truth: NDArray[np.uint8], *, mask: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """(H, W, 3): the mean absolute difference over the channels, from 0 (dark) to WORST (bright).

    Args:
        picture: (H, W, 3).
        truth: (H, W, 3).
        mask: (H, W), where the truth counts; elsewhere the map is grey. None is everywhere.
    """
    from matplotlib import colormaps

    if picture.shape != truth.shape:
        raise ShapeError(f"the picture is {picture.shape}; its truth is {truth.shape}")
    lut = (colormaps[ERROR_MAP](np.arange(256))[:, :3] * 255).round().astype(np.uint8)
    difference = np.abs(picture.astype(np.int16) - truth).sum(axis=2, dtype=np.int32)
    level = np.minimum(difference * (1 / (3 * WORST)), 255).astype(np.uint8)
    out = lut[level]
    if mask is not None:
        out[~mask] = 128
    return out


def color_scale() -> str:
    """The colours of an error map from 0 to WORST, as a CSS gradient."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    stops = [to_hex(colormaps[ERROR_MAP](share)) for share in np.linspace(0, 1, 9)]
    return f"linear-gradient(to right, {', '.join(stops)})"


def data_uri(data: bytes, kind: str) -> str:
    """The bytes of a file of a MIME kind, such as ``image/png``, for a page to hold them itself."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def _tile(label: str, alt: str, encoded: tuple[str, int, int]) -> Tile:
    return Tile(label, alt, *encoded)


def _photograph(picture: NDArray[np.uint8], side: int) -> tuple[str, int, int]:
    """As JPEG, each pixel the mean of what it stands for."""
    from PIL import Image

    image = Image.fromarray(picture)
    image.thumbnail((side, side), Image.Resampling.BOX)
    out = io.BytesIO()
    image.save(out, format="JPEG", quality=QUALITY)
    return data_uri(out.getvalue(), "image/jpeg"), image.width, image.height


def _flat_colours(picture: NDArray[np.uint8], side: int) -> tuple[str, int, int]:
    """As PNG of few colours, each pixel one of those it stands for."""
    from PIL import Image

    image = Image.fromarray(picture)
    image.thumbnail((side, side), Image.Resampling.NEAREST)
    out = io.BytesIO()
    image.quantize(8, dither=Image.Dither.NONE).save(out, format="PNG")
    return data_uri(out.getvalue(), "image/png"), image.width, image.height
