"""Pictures side by side: a scene's context, hint, completion and truth; methods on random views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.experiments.cases import Case
from gvtools.completers.base import Completer
from gvtools.training.run import write_png

# Scenes that pictures are written of.
SHOWN = 12
GAP = 4
# Of a sheet that compares methods, px: a picture, and the line of titles.
TILE, TITLE = 112, 16


def write_pictures(
    folder: Path, cases: Sequence[Case], completer: Completer, *, seed: int = 0
) -> None:
    """Four bands a scene, a column a view: context, projection, completion, truth.

    Args:
        folder: made if absent.
        cases: the first ``SHOWN`` are shown.
        completer: makes the completion.
        seed: of the completer.
    """
    for number, case in enumerate(cases[:SHOWN]):
        made = completer.complete(case.context, case.guidance, seed=seed)
        size = case.rgb.shape[1:3]
        context = [view.rgb for view in case.context if view.rgb.shape[:2] == size]
        bands = [
            _band(list(pictures), len(case.rgb))
            for pictures in (context[: len(case.rgb)], case.guidance.rgb, made.rgb, case.rgb)
        ]
        write_png(folder / f"scene_{number:03d}.png", np.concatenate(bands))


def _band(pictures: list[np.ndarray], columns: int) -> np.ndarray:
    """Pictures in [0, 1] side by side, white where there are fewer."""
    height, width = pictures[0].shape[:2] if pictures else (1, 1)
    white = np.ones((height, width, 3))
    tiles = [*pictures, *[white] * (columns - len(pictures))]
    padded = np.pad(np.stack(tiles), ((0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=1)
    joined = np.concatenate(list(padded), axis=1)
    return np.rint(np.clip(joined, 0, 1) * 255).astype(np.uint8)


def comparison_sheet(titles: Sequence[str], rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Pictures of one row beside each other, the middle squares at one size, under their titles.

    Args:
        titles: of the columns.
        rows: (H, W, 3) pictures in [0, 1], one a column.

    Returns:
        (H, W, 3) uint8.
    """
    from PIL import Image, ImageDraw

    band = np.full((TITLE, len(titles) * (TILE + GAP), 3), 255, np.uint8)
    heading = Image.fromarray(band)
    draw = ImageDraw.Draw(heading)
    for column, title in enumerate(titles):
        draw.text((column * (TILE + GAP) + 2, 2), title, fill=(0, 0, 0))
    shown = [_band([_tile(picture) for picture in row], len(titles)) for row in rows]
    return np.concatenate([np.asarray(heading), *shown])


def _tile(picture: np.ndarray) -> np.ndarray:
    """(TILE, TILE, 3) in [0, 1], of the picture's middle square."""
    from PIL import Image

    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = np.clip(picture[top : top + side, left : left + side], 0, 1)
    image = Image.fromarray(np.rint(255 * square).astype(np.uint8))
    return np.asarray(image.resize((TILE, TILE), Image.Resampling.BOX)) / 255
