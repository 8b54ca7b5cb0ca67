"""Pictures of targets beside each other: contact sheets of one run, and of several methods.

A contact sheet of a run is small files, which a page lays out as its width allows. One of several
methods is one picture: truth, pictures and error maps, a row of tiles a view. What the context
never observed is outlined on the error maps; below the truth stands the truth with everything else
dimmed.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.runs.target_files import SUPPORT_SCANNED
from viz.plots.canvas import BLUE, GREEN, ORANGE, SKY, rgb_of

if TYPE_CHECKING:
    from PIL.Image import Image

    from gvtools.scenes.scene import Frame, View

# Longer side of a thumbnail, pixels: twice what a phone shows of it, for its dense screen.
SIDE = 320
QUALITY = 80
# Mean absolute difference over the channels, of a range of 1, at which an error map is brightest.
WORST = 0.25
ERROR_MAP = "inferno"
# Of the validity: what stands on observations, on a scan's alone, on what was generated before, on
# nothing.
SUPPORT = {"observed": BLUE, "scanned": GREEN, "generated": ORANGE, "hole": "#1a1a1a"}
# Of the sheet of several methods, pixels.
GAP, LETTERS = 6, 15
BACKGROUND, INK, MISSING = (255, 255, 255), (20, 20, 20), (200, 200, 200)
DIM = 0.2  # of the brightness is left where the context observed
RIM = 5  # pixels of the square that thins a region to its outline: two on either side

Rgb = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Thumbnail:
    """A small picture of a page."""

    label: str
    alt: str  # the same in a sentence, for those who cannot see it
    uri: str  # the picture as a data URI
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class JudgedView:
    """One view (H, W) with the pictures that methods made of it."""

    name: str
    truth: Rgb | None
    mask: Mask | None  # where the truth counts; None is everywhere
    never_observed: Mask  # by the context
    pictures: Mapping[str, Rgb | None]  # by method; None where it has none of this view


def contact_row(
    name: str,
    *,
    hint: Rgb,  # the memory's projection that the completer was given
    support: NDArray[np.uint8],  # (H, W) what the hint stands on, as ``valid_NAME.png`` has it
    completion: Rgb,
    truth: Frame | None = None,
    context: View | None = None,  # the given view nearest to the target
) -> list[Thumbnail]:
    """Context, hint, validity, completion, truth and error map, as far as there are pictures."""
    tiles = []

    def add(label: str, alt: str, picture: Rgb, *, flat: bool = False) -> None:
        tiles.append(Thumbnail(label, alt, *_encoded(picture, SIDE, flat=flat)))

    if context is not None:
        add("context", f"context view {context.name}, the nearest to {name}", context.load().rgb)
    add("hint", f"the memory projected into {name}", hint)
    observed, scanned = support >= SUPPORT_SCANNED, support == SUPPORT_SCANNED
    of_scan = f"{scanned.mean():.0%} of it scanned, " if scanned.any() else ""
    text = (
        f"validity of {name}: {observed.mean():.0%} observed, {of_scan}"
        f"{((support > 0) & ~observed).mean():.0%} generated before"
    )
    add("validity", text, support_map(support), flat=True)
    add("completion", f"completed picture of {name}", completion)
    if truth is not None:
        add("truth", f"photograph {name}", truth.rgb)
        add("error", f"error map of {name}", error_map(completion, truth.rgb, mask=truth.mask))
    return tiles


def support_map(support: NDArray[np.uint8]) -> Rgb:
    """(H, W, 3): the colours of SUPPORT, of a ``valid_NAME.png`` (H, W)."""
    kinds = [support > SUPPORT_SCANNED, support == SUPPORT_SCANNED, support > 0]
    which = np.select(kinds, range(3), 3)
    return np.array([rgb_of(color) for color in SUPPORT.values()], np.uint8)[which]


def error_map(picture: Rgb, truth: Rgb, *, mask: Mask | None = None) -> Rgb:
    """(H, W, 3): the mean absolute difference over the channels, from 0 (dark) to WORST (bright).

    It is grey where the (H, W) mask says that the truth does not count.
    """
    from matplotlib import colormaps

    lut = (colormaps[ERROR_MAP](np.arange(256))[:, :3] * 255).round().astype(np.uint8)
    difference = np.abs(picture.astype(np.int16) - truth).sum(axis=2, dtype=np.int32)
    level = np.minimum(difference * (1 / (3 * WORST)), 255).astype(np.uint8)
    out = lut[level]
    if mask is not None:
        out[~mask] = 128
    return out


def error_colors() -> str:
    """The colours of an error map from 0 to WORST, as a CSS gradient."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    stops = [to_hex(colormaps[ERROR_MAP](share)) for share in np.linspace(0, 1, 9)]
    return f"linear-gradient(to right, {', '.join(stops)})"


def data_uri(data: bytes, kind: str) -> str:
    """The bytes of a file of a MIME kind, such as ``image/png``, for a page to hold them itself."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def thumbnail(label: str, picture: Rgb, *, side: int = SIDE) -> Thumbnail:
    """A small picture, its longer side of at most ``side`` pixels."""
    return Thumbnail(label, label, *_encoded(picture, side, flat=False))


def _encoded(picture: Rgb, side: int, *, flat: bool) -> tuple[str, int, int]:
    """A thumbnail as a data URI, and its width and height.

    As JPEG, each pixel the mean of those it stands for; a flat picture as PNG of few colours, each
    pixel one of them.
    """
    from PIL import Image

    image = Image.fromarray(picture)
    out = io.BytesIO()
    image.thumbnail((side, side), Image.Resampling.NEAREST if flat else Image.Resampling.BOX)
    if flat:
        image.quantize(8, dither=Image.Dither.NONE).save(out, format="PNG")
    else:
        image.save(out, format="JPEG", quality=QUALITY)
    kind = "image/png" if flat else "image/jpeg"
    return data_uri(out.getvalue(), kind), image.width, image.height


def method_sheet(views: Sequence[JudgedView]) -> Rgb:
    """(H, W, 3): for each view a line of pictures, and a line of error maps below.

    There is at least one view, and all have the same methods.
    """
    from PIL import Image, ImageDraw

    blocks = [_block(view) for view in views]
    width, height = max(b.width for b in blocks), sum(b.height for b in blocks)
    canvas = Image.new("RGB", (width, height + LETTERS * 2), BACKGROUND)
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


def _block(view: JudgedView) -> Image:
    """The tiles of one view: truth and pictures, and error maps below where there is a truth."""
    from PIL import Image, ImageDraw

    height, width = view.never_observed.shape
    scale = min(SIDE / max(height, width), 1.0)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    lines = 1 if view.truth is None else 2
    step = size[0] + GAP
    whole = (GAP + step * (len(view.pictures) + 1), lines * (size[1] + GAP) + LETTERS + 2 * GAP)
    block = Image.new("RGB", whole, BACKGROUND)
    draw, font = ImageDraw.Draw(block), _font(LETTERS - 2)
    heads = [view.name if view.truth is None else f"{view.name}, truth"]
    first, second = [view.truth], [None if view.truth is None else _dimmed(view)]
    for method, picture in view.pictures.items():
        heads.append(_heading(view, method))
        first.append(picture)
        error = None
        if picture is not None and view.truth is not None:
            error = error_map(picture, view.truth, mask=view.mask)
        second.append(error)
    for column, head in enumerate(heads):
        left, top = GAP + column * step, LETTERS + GAP
        # Its beginning is left out where it is wider than the tile.
        while len(head) > 4 and draw.textlength(head, font=font) > size[0]:
            head = "…" + head[2:]
        draw.text((left, GAP // 2), head, INK, font=font)
        block.paste(_tile(first[column], size), (left, top))
        if lines == 2:
            outlined = view.never_observed if column else None
            block.paste(_tile(second[column], size, outlined), (left, top + size[1] + GAP))
    return block


def _dimmed(view: JudgedView) -> Rgb:
    """The truth, dark where the context observed it."""
    share = np.where(view.never_observed, 1.0, DIM)[..., None]
    return np.rint(view.truth * share).astype(np.uint8)


def _heading(view: JudgedView, method: str) -> str:
    from gvtools.evaluation.images import psnr

    picture = view.pictures[method]
    if picture is None:
        return f"{method}: no picture"
    if view.truth is None:
        return method
    value = psnr(picture, view.truth, mask=view.mask)
    return method if value is None else f"{method}: {value:.2f}"


def _tile(picture: Rgb | None, size: tuple[int, int], outlined: Mask | None = None) -> Image:
    """A thumbnail, grey where there is no picture, with the outline of a region."""
    import cv2
    from PIL import Image

    if picture is None:
        return Image.new("RGB", size, MISSING)
    small = Image.fromarray(picture).resize(size, Image.Resampling.BOX)
    if outlined is None or not outlined.any():
        return small
    # The inner rim of what covers at least half of a thumbnail's pixel.
    share = cv2.resize(outlined.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    inside = (share >= 0.5).astype(np.uint8)
    rim = inside - cv2.erode(inside, np.ones((RIM, RIM), np.uint8), borderValue=1)
    pixels = np.array(small)
    pixels[rim.astype(bool)] = rgb_of(SKY)
    return Image.fromarray(pixels)


def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)
