"""Curves: accuracy over the number of views and over time, and the losses of a training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from viz.plots.canvas import BLACK, BLUE, COLORFUL, GREY, LEGEND, LINES, ORANGE, RED, figure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Number of context views, mean, lower and upper end of its interval.
Point = tuple[int, float, float | None, float | None]
# Side by side, so that intervals of one number of views do not hide each other; views.
APART = 0.12
METHODS = tuple(zip((*COLORFUL, BLACK, GREY), "os^vDPX*", strict=True))
# The axis of time is logarithmic where the largest is more than so many times the smallest.
LOGARITHMIC = 3


def draw_by_views(lines: Mapping[str, Sequence[Point]], *, label: str = "PSNR [dB]") -> Figure:
    """A line a method, of its points by name, with the interval of each mean."""

    def panel(axes: Axes) -> None:
        for number, (name, points) in enumerate(lines.items()):
            color, marker = METHODS[number % len(METHODS)]
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


Records = Sequence[Mapping[str, Any]]

# What a record holds beside losses.
NO_LOSSES = ("step", "seconds", "rate", "skipped", "gradient_norm")
NO_LOSS_ENDS = ("_empty", "_pixels", "_without_scale", "_psnr", "_rel")
TOTAL = "loss"
PALETTE = (*COLORFUL, GREY)
STYLES = ("-", "--", ":")
# Curves are drawn as the running median over this share of the records, over their raw values.
WINDOW = 1 / 30
# The axis is linear up to the largest value over this.
LINEAR = 30.0


def draw_losses(stages: Mapping[str, Records], *, title: str | None = None) -> Figure:
    """The losses against the step, each stage in a panel of its own.

    Values are drawn faintly, their running median boldly. The axis is logarithmic; where parts
    of a loss are zero or negative, it is linear below about a thirtieth of the largest value.
    Records of a stage's log have ``step`` and values by name.
    """
    for stage, records in stages.items():
        if not loss_names(records):
            raise OptionError(f"losses: stage {stage!r} has no record with a loss; expected one")
    panels = [partial(_panel, stage=stage, records=records) for stage, records in stages.items()]
    return figure_of(panels, title=title)


def loss_names(records: Records) -> list[str]:
    """The losses that the records hold: the total first, then its parts by name."""
    names = {
        name
        for record in records
        for name, value in record.items()
        if isinstance(value, (int, float))
        and name not in NO_LOSSES
        and not name.endswith(NO_LOSS_ENDS)
    }
    return sorted(names, key=lambda name: (name != TOTAL, name))


def running_median(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """The median over ``width`` neighbours (odd), fewer at the ends; NaN counts for nothing."""
    reach = width // 2
    padded = np.pad(values, reach, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    out = np.full(len(values), np.nan)
    known = np.isfinite(windows).any(axis=1)
    out[known] = np.nanmedian(windows[known], axis=1)
    return out


def _panel(axes: Axes, *, stage: str, records: Records) -> None:
    steps = np.array([record["step"] for record in records])
    width = max(1, round(WINDOW * len(records))) | 1
    least, largest = np.inf, 0.0
    names = loss_names(records)
    for number, name in enumerate(names):
        values = np.array([_number(record.get(name)) for record in records])
        least = min(least, float(np.nanmin(values, initial=np.inf)))
        largest = max(largest, float(np.nanmax(np.abs(values), initial=0)))
        part = number - (TOTAL in names)
        color = BLACK if name == TOTAL else PALETTE[part % len(PALETTE)]
        line = "-" if name == TOTAL else STYLES[part // len(PALETTE) % len(STYLES)]
        axes.plot(steps, values, color=color, linewidth=0.5, alpha=0.3)
        axes.plot(
            steps, running_median(values, width), line, color=color, label=name,
            linewidth=2.0 if name == TOTAL else 1.3, marker="o" if len(records) == 1 else None,
        )  # fmt: skip
    if least > 0:
        axes.set_yscale("log")
    else:
        # A power of ten, so that no tick but zero lies within the linear part.
        exponent = np.floor(np.log10(max(largest / LINEAR, 1e-12)))
        axes.set_yscale("symlog", linthresh=10.0**exponent)
    axes.set_title(stage)
    axes.set_xlabel("training step")
    axes.set_ylabel("loss (no unit)")
    axes.grid(**LINES)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), **LEGEND)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else float("nan")
