"""Accuracy against time and memory, trial by trial, with the front that no trial beats."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from viz.plots.canvas import figure_of
from viz.plots.palette import BLUE, GREY, ORANGE, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The horizontal axis is logarithmic where the largest is more than so many times the smallest.
LOGARITHMIC = 3
AXES = {"seconds": ("seconds of a whole run", 1.0), "bytes": ("memory, MiB", 2.0**20)}


def draw_pareto(
    trials: Sequence[Any],
    *,
    front: Sequence[Any],
    chosen: Any | None,
    budget: tuple[str, float | None],
    title: str | None = None,
) -> Figure:
    """PSNR over seconds of a run and over the memory's size, logarithmic where they spread.

    Args:
        trials: at least one, each with ``label``, ``seconds``, ``bytes`` and ``psnr``.
        front: those that no other beats in both time and PSNR, fastest first.
        chosen: the recommended one; None where none is within the budget.
        budget: "seconds" or "bytes", and how many; None for no limit.
        title: of the scene.

    Returns:
        A figure with its own Agg canvas.
    """
    from matplotlib.ticker import LogLocator

    def panel(axes: Axes, key: str) -> None:
        label, unit = AXES[key]
        mark = partial(_mark, axes, key)
        profiles = [trial for trial in trials if trial.label.startswith("profile ")]
        # Marks differ, not colours alone.
        mark([t for t in trials if t not in profiles], name="trial", style=_marks("o", GREY))
        mark(profiles, name="profile", style=_marks("^", ORANGE))
        for trial in profiles if key == "seconds" else ():
            _name(axes, trial)
        if key == "seconds":
            mark(
                front, name="front", style={"color": BLUE, "drawstyle": "steps-post", "zorder": 1.5}
            )
        if chosen is not None:
            mark(
                [chosen],
                name="recommended",
                style=_marks("o", RED, fillstyle="none", markersize=13),
            )
        values = [getattr(trial, key) / unit for trial in trials]
        if budget[0] == key and budget[1] is not None:
            values.append(budget[1] / unit)
            axes.axvline(values[-1], color=RED, linestyle="--", label=f"budget {values[-1]:g}")
        if max(values) > LOGARITHMIC * min(values) > 0:
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.set_xlabel(label)
        axes.set_ylabel("PSNR, dB, whole pictures")
        axes.legend(fontsize="small", loc="lower right")

    return figure_of([partial(panel, key=key) for key in AXES], title=title)


def _marks(marker: str, color: str, **more: Any) -> dict[str, Any]:
    return {"linestyle": "none", "marker": marker, "color": color, **more}


def _mark(axes: Axes, key: str, trials: Sequence[Any], *, name: str, style: dict[str, Any]) -> None:
    """Plot trials by their seconds or bytes."""
    x = [getattr(trial, key) / AXES[key][1] for trial in trials]
    axes.plot(x, [trial.psnr for trial in trials], label=name, **style)


def _name(axes: Axes, profile: Any) -> None:
    """Write a profile's name beside its mark."""
    axes.annotate(
        profile.label.removeprefix("profile "), (profile.seconds, profile.psnr), xytext=(6, -3),
        textcoords="offset points", fontsize="small", parse_math=False,
    )  # fmt: skip
