"""Accuracy against time, trial by trial, with the front that no trial beats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from viz.plots.canvas import figure_of
from viz.plots.palette import BLUE, GREY, ORANGE, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The horizontal axis is logarithmic where the largest is more than so many times the smallest.
LOGARITHMIC = 3


def draw_pareto(
    trials: Sequence[Any],
    *,
    front: Sequence[Any],
    chosen: Any | None,
    budget: float | None,
    title: str | None = None,
) -> Figure:
    """PSNR over seconds of a run, logarithmic where they spread.

    Args:
        trials: at least one, each with ``label``, ``seconds`` and ``psnr``.
        front: those that no other beats in both time and PSNR, fastest first.
        chosen: the recommended one; None where none is within the budget.
        budget: seconds; None for no limit.
        title: of the scene.

    Returns:
        A figure with its own Agg canvas.
    """
    from matplotlib.ticker import LogLocator

    def panel(axes: Axes) -> None:
        def mark(some: Sequence[Any], name: str, style: dict[str, Any]) -> None:
            axes.plot([t.seconds for t in some], [t.psnr for t in some], label=name, **style)

        profiles = [trial for trial in trials if trial.label.startswith("profile ")]
        # Marks differ, not colours alone.
        mark([t for t in trials if t not in profiles], "trial", _marks("o", GREY))
        mark(profiles, "profile", _marks("^", ORANGE))
        for trial in profiles:
            _name(axes, trial)
        mark(front, "front", {"color": BLUE, "drawstyle": "steps-post", "zorder": 1.5})
        if chosen is not None:
            mark([chosen], "recommended", _marks("o", RED, fillstyle="none", markersize=13))
        values = [trial.seconds for trial in trials]
        if budget is not None:
            values.append(budget)
            axes.axvline(budget, color=RED, linestyle="--", label=f"budget {budget:g}")
        if max(values) > LOGARITHMIC * min(values) > 0:
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.set_xlabel("seconds of a whole run")
        axes.set_ylabel("PSNR, dB, whole pictures")
        axes.legend(fontsize="small", loc="lower right")

    return figure_of([panel], title=title)


def _marks(marker: str, color: str, **more: Any) -> dict[str, Any]:
    return {"linestyle": "none", "marker": marker, "color": color, **more}


def _name(axes: Axes, profile: Any) -> None:
    """Write a profile's name beside its mark."""
    axes.annotate(
        profile.label.removeprefix("profile "), (profile.seconds, profile.psnr), xytext=(6, -3),
        textcoords="offset points", fontsize="small", parse_math=False,
    )  # fmt: skip
