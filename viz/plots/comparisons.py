"""Figures that compare methods and trials: accuracy over the number of views, and over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from viz.plots.canvas import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SKY,
    figure_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Number of context views, mean, lower and upper end of its interval.
Point = tuple[int, float, float | None, float | None]
# Side by side, so that intervals of one number of views do not hide each other; views.
APART = 0.12
STYLES = tuple(zip((BLUE, ORANGE, GREEN, RED, SKY, PINK, BLACK, GREY), "os^vDPX*", strict=True))
# The axis of time is logarithmic where the largest is more than so many times the smallest.
LOGARITHMIC = 3


def draw_by_views(lines: Mapping[str, Sequence[Point]], *, label: str = "PSNR [dB]") -> Figure:
    """A line a method, of its points by name, with the interval of each mean."""

    def panel(axes: Axes) -> None:
        for number, (name, points) in enumerate(lines.items()):
            color, marker = STYLES[number % len(STYLES)]
            shift = APART * (number - (len(lines) - 1) / 2)
            views, means = [p[0] + shift for p in points], [p[1] for p in points]
            # Without an interval, the ends are the mean itself.
            below = [p[1] - (p[1] if p[2] is None else p[2]) for p in points]
            above = [(p[1] if p[3] is None else p[3]) - p[1] for p in points]
            axes.errorbar(
                views, means, yerr=(below, above), color=color, marker=marker, capsize=3, label=name
            )
        axes.set_xticks(sorted({p[0] for points in lines.values() for p in points}))
        axes.set_xlabel("context views")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.legend()

    return figure_of([panel])


def draw_pareto(
    trials: Sequence[Any],
    *,
    front: Sequence[Any],
    chosen: Any | None,
    budget: float | None,
    title: str | None = None,
) -> Figure:
    """PSNR over seconds of a run, logarithmic where they spread, with the front.

    Args:
        trials: at least one, each with ``label``, ``seconds`` and ``psnr``.
        front: those that no other beats in both time and PSNR, fastest first.
        chosen: the recommended one; None where none is within the budget.
        budget: seconds; None for no limit.
    """
    from matplotlib.ticker import LogLocator

    def panel(axes: Axes) -> None:
        def mark(some: Sequence[Any], name: str, style: dict[str, Any]) -> None:
            axes.plot([t.seconds for t in some], [t.psnr for t in some], label=name, **style)

        profiles = [trial for trial in trials if trial.label.startswith("profile ")]
        # Marks differ, not colours alone.
        mark([t for t in trials if t not in profiles], "trial", _marks("o", GREY))
        mark(profiles, "profile", _marks("^", ORANGE))
        for profile in profiles:
            axes.annotate(
                profile.label.removeprefix("profile "), (profile.seconds, profile.psnr),
                xytext=(6, -3), textcoords="offset points", fontsize="small", parse_math=False,
            )  # fmt: skip
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
