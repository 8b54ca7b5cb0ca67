"""Figures of one panel or several, each on an Agg canvas of its own, and the colours they share.

A panel is a function that draws on the axes it is given. A page that is read on a phone shows the
panels one by one; a file holds them side by side. The state of pyplot is left alone.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Panel = Callable[["Axes"], None]
Rounds = Sequence[Mapping[str, Any]]  # the lines of a run's ``rounds.jsonl``, in order; one or more

# Okabe and Ito's palette, which the common forms of colour blindness tell apart.
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PINK = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
GREY = "#999999"
COLORFUL = (BLUE, ORANGE, GREEN, RED, SKY, PINK)

COLORS = {
    "observed": BLUE,
    "generated": ORANGE,
    "scanned": GREEN,
    "voxels": BLACK,
    "added": GREEN,
    "merged": SKY,
    "rejected": RED,
    "new voxels": GREY,
    "depth": BLUE,
    "fuse": GREEN,
    "project": SKY,
    "complete": ORANGE,
    "align": PINK,
}
HATCHES = {
    "generated": "//",
    "scanned": "..",
    "rejected": "xx",
    "merged": "..",
    "complete": "//",
    "align": "xx",
}
# Of anything that has no colour of its own.
OTHERS = (GREY, RED, BLACK, YELLOW)

SIZE = (5.5, 3.75)  # inches, of each of several panels
ALONE = (4.7, 3.4)  # of a single one, whose letters stay legible on a phone
LINES: dict[str, Any] = {"color": "#dddddd", "linewidth": 0.6}  # of a grid
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": "small"}


def rgb_of(color: str) -> tuple[int, int, int]:
    """A colour "#rrggbb" as bytes."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def blank_figure(size: tuple[float, float], **options: Any) -> Figure:
    """A figure of a size in inches with its own Agg canvas."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained", **options)
    FigureCanvasAgg(figure)
    return figure


def figure_of(panels: Sequence[Panel], *, title: str | None = None, columns: int = 2) -> Figure:
    """At least one panel, row by row, at most so many side by side."""
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    width, height = SIZE if len(panels) > 1 else ALONE
    figure = blank_figure((width * columns, height * rows))
    for number, panel in enumerate(panels, start=1):
        axes = figure.add_subplot(rows, columns, number)
        panel(axes)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_axisbelow(True)
        # Names of projects and of stages are no formulas, even with dollar signs in them.
        legend = axes.get_legend()
        for words in (axes.title, *(legend.get_texts() if legend else ())):
            words.set_parse_math(False)
    if title is not None:
        figure.suptitle(title, parse_math=False)
    return figure


def png(figure: Figure, *, dpi: int = 120) -> bytes:
    """The figure as the bytes of a PNG."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi)
    return out.getvalue()
