"""Accuracy against time and memory, trial by trial, with the front that no trial beats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError
from viz.plots.canvas import chosen, figure_of
from viz.plots.palette import BLACK, BLUE, GREY, ORANGE, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Trial = Mapping[str, Any]

# Marks differ, not colours alone.
STYLES: dict[str, Any] = {
    "trial": {"color": GREY, "marker": "o"},
    "profile": {"color": ORANGE, "marker": "^"},
    "start": {"color": BLACK, "marker": "D"},
}
# The horizontal axis is logarithmic where the largest is more than so many times the smallest.
LOGARITHMIC = 3
SCALES = {"seconds": 1.0, "bytes": 2.0**20}
LABELS = {"seconds": "seconds of a whole run", "bytes": "memory, MiB"}


@dataclass(frozen=True)
class TradeOff:
    """What a sweep of settings came to.

    Attributes:
        source: the file that it was read from.
        trials: on all targets, each with ``seconds``, ``bytes``, ``psnr``, ``label`` and ``kind``
            (of STYLES).
        front: those that no other beats in both time and PSNR, fastest first.
        recommended: the chosen one; None where none is within the budget.
        budget: seconds; None without one.
    """

    source: str
    trials: Sequence[Trial]
    front: Sequence[Trial]
    recommended: Trial | None
    budget: float | None


def draw_pareto(
    found: TradeOff, *, title: str | None = None, panels: Sequence[str] | None = None
) -> Figure:
    """PSNR over seconds of a run and over the memory's size, logarithmic where they spread.

    Args:
        found: what a sweep came to.
        title: of the scene.
        panels: of "seconds" and "bytes"; None is both.

    Returns:
        A figure with its own Agg canvas.

    Raises:
        OptionError: no trials, or no such panel.
    """
    if not found.trials:
        raise OptionError("a trade-off without trials; expected one at least")

    def panel(axes: Axes, key: str) -> None:
        _points(axes, key, found.trials, recommended=found.recommended)
        limit: list[float] = []
        if key == "seconds":
            _front(axes, found)
            limit = [] if found.budget is None else [found.budget]
        _spread(axes, [*(trial[key] for trial in found.trials), *limit])
        axes.legend(fontsize="small", loc="lower right")

    known = {key: partial(panel, key=key) for key in SCALES}
    return figure_of(chosen(known, panels), title=title)


def _points(axes: Axes, key: str, trials: Sequence[Trial], *, recommended: Trial | None) -> None:
    scale = SCALES[key]
    for kind, style in STYLES.items():
        of_kind = [trial for trial in trials if trial["kind"] == kind]
        if of_kind:
            axes.scatter(
                [trial[key] / scale for trial in of_kind],
                [trial["psnr"] for trial in of_kind],
                label=kind,
                s=36,
                zorder=3,
                **style,
            )
    for trial in trials:
        if trial["kind"] == "profile" and key == "seconds":
            axes.annotate(
                str(trial["label"]).removeprefix("profile "),
                (trial[key] / scale, trial["psnr"]),
                xytext=(6, -3),
                textcoords="offset points",
                fontsize="small",
                parse_math=False,
            )
    if recommended is not None:
        axes.scatter(
            [recommended[key] / scale],
            [recommended["psnr"]],
            s=180,
            facecolors="none",
            edgecolors=RED,
            linewidths=2,
            zorder=4,
            label="recommended",
        )
    axes.grid(alpha=0.3)
    axes.set_xlabel(LABELS[key])
    axes.set_ylabel("PSNR, dB, whole pictures")


def _spread(axes: Axes, values: Sequence[float]) -> None:
    from matplotlib.ticker import LogLocator

    if max(values) > LOGARITHMIC * min(values) > 0:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.minorticks_off()


def _front(axes: Axes, found: TradeOff) -> None:
    axes.step(
        [trial["seconds"] for trial in found.front],
        [trial["psnr"] for trial in found.front],
        where="post",
        color=BLUE,
        zorder=2,
        label="front",
    )
    if found.budget is not None:
        axes.axvline(found.budget, color=RED, linestyle="--", label=f"budget {found.budget:g} s")
