"""Figures of one panel or several, each on an Agg canvas of its own: pyplot's state is left alone.

A panel is a function that draws on the axes it is given. A page that is read on a phone shows the
panels one by one; a file holds them side by side.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Panel = Callable[["Axes"], None]
Rounds = Sequence[Mapping[str, Any]]

SIZE = (5.5, 3.75)  # inches, of each of several panels
ALONE = (4.7, 3.4)  # of a single one, whose letters stay legible on a phone


def figure_of(panels: Sequence[Panel], *, title: str | None = None, columns: int = 2) -> Figure:
    """A figure with the panels row by row.

    Args:
        panels: at least one.
        title: above all of them; None leaves it out.
        columns: at most so many panels side by side.

    Returns:
        A figure with its own Agg canvas.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    width, height = SIZE if len(panels) > 1 else ALONE
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for number, panel in enumerate(panels, start=1):
        axes = figure.add_subplot(rows, columns, number)
        panel(axes)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_axisbelow(True)
        _take_literally(axes)
    if title is not None:
        figure.suptitle(title, parse_math=False)
    return figure


def _take_literally(axes: Axes) -> None:
    """Names of projects and of stages are no formulas, even with dollar signs in them."""
    legend = axes.get_legend()
    for words in (axes.title, *(legend.get_texts() if legend else ())):
        words.set_parse_math(False)


def chosen(panels: Mapping[str, Panel], names: Sequence[str] | None) -> list[Panel]:
    """The named panels, in the order of the names; all of them without names."""
    names = tuple(panels) if names is None else tuple(names)
    unknown = [name for name in names if name not in panels]
    if unknown or not names:
        raise OptionError(f"panels {', '.join(names)!r}; expected some of {', '.join(panels)}")
    return [panels[name] for name in names]


def check_rounds(rounds: Rounds) -> None:
    """Refuse to draw nothing."""
    if not rounds:
        raise OptionError("growth: no rounds; expected the lines of a run's rounds.jsonl")


def round_axis(axes: Axes, rounds: Rounds) -> None:
    """The horizontal axis of a panel over rounds."""
    axes.set_xticks(range(len(rounds)), [str(entry["round"]) for entry in rounds])
    if len(rounds) > 20:
        axes.set_xticks(range(0, len(rounds), len(rounds) // 10))
    axes.set_xlim(-0.6, len(rounds) - 0.4)
    axes.set_xlabel("round")
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)


def png(figure: Figure, *, dpi: int = 120) -> bytes:
    """The figure as the bytes of a PNG."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi)
    return out.getvalue()
