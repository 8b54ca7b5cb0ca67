"""How much of the targets the memory supports, round by round, before and after each."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from viz.plots.canvas import Rounds, check_rounds, figure_of, round_axis
from viz.plots.palette import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_coverage(rounds: Rounds, *, title: str | None = None) -> Figure:
    """Coverage against round, in percent of the pixels of each round's targets.

    Args:
        rounds: the lines of a run's ``rounds.jsonl``, in order.
        title: what was reconstructed.

    Raises:
        OptionError: no rounds.
    """
    check_rounds(rounds)
    return figure_of([partial(coverage_panel, rounds=rounds)], title=title)


def coverage_panel(axes: Axes, *, rounds: Rounds) -> None:
    """The same on axes that are given."""
    round_axis(axes, rounds)
    axes.set_title("target pixels that the memory supports")
    axes.set_ylabel("coverage, % of pixels")
    axes.set_ylim(0, 126)
    axes.set_yticks(range(0, 101, 20))
    known = [
        (i, 100 * entry["coverage_before"], 100 * entry["coverage_after"])
        for i, entry in enumerate(rounds)
        if entry["coverage_before"] is not None and entry["coverage_after"] is not None
    ]
    if not known:
        axes.text(0.5, 0.5, "no targets", transform=axes.transAxes, ha="center")
        return
    at, before, after = zip(*known, strict=True)
    axes.vlines(at, before, after, color="#999999", linewidth=2, zorder=2)
    axes.scatter(
        at, before, s=45, color="white", edgecolor=COLORS["observed"], linewidth=1.8, zorder=3,
        label="before the round",
    )  # fmt: skip
    axes.scatter(at, after, s=45, color=COLORS["observed"], zorder=3, label="after the round")
    if len(known) <= 12:
        for x, low, high in known:
            axes.annotate(f"{high:.1f}", (x, high), (0, 6), textcoords="offset points",
                          ha="center", fontsize="small")  # fmt: skip
            if high - low > 6:
                axes.annotate(f"{low:.1f}", (x, low), (0, -13), textcoords="offset points",
                              ha="center", fontsize="small")  # fmt: skip
    axes.legend(ncols=2, loc="upper left", frameon=False, fontsize="small")
