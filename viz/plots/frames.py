"""Pictures of a run side by side: what was given, and some targets of each round."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from viz.plots.canvas import blank_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROWS = ("completed", "photograph")
# Inches of a picture's width.
WIDE = 2.2


def draw_frames(
    columns: Sequence[tuple[str, Sequence[NDArray[np.uint8] | None]]], *, title: str | None = None
) -> Figure:
    """A column of a label and a picture for each of ROWS; a row that has none is left out."""
    kept = [row for row in range(len(ROWS)) if any(p[row] is not None for _, p in columns)]
    first = next(picture for _, pictures in columns for picture in pictures if picture is not None)
    tall = WIDE * first.shape[0] / first.shape[1] + 0.3
    figure = blank_figure((WIDE * len(columns), tall * len(kept) + 0.4))
    for place, row in enumerate(kept):
        for column, (label, pictures) in enumerate(columns):
            axes: Any = figure.add_subplot(
                len(kept), len(columns), place * len(columns) + column + 1
            )
            axes.set_xticks([])
            axes.set_yticks([])
            if column == 0:
                axes.set_ylabel(ROWS[row])
            if place == 0:
                axes.set_title(label, fontsize=7, parse_math=False)
            if pictures[row] is not None:
                axes.imshow(pictures[row])
            else:
                axes.axis("off")
    if title is not None:
        figure.suptitle(title, parse_math=False)
    return figure
