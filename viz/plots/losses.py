"""Loss curves of a training: one panel a stage, its loss and the parts of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from viz.plots.canvas import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LEGEND,
    LINES,
    ORANGE,
    PINK,
    RED,
    SKY,
    figure_of,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Records = Sequence[Mapping[str, Any]]

# What a record holds beside losses.
NO_LOSSES = ("step", "seconds", "rate", "skipped", "gradient_norm")
NO_LOSS_ENDS = ("_empty", "_pixels", "_without_scale", "_psnr", "_rel")
TOTAL = "loss"
PALETTE = (BLUE, ORANGE, GREEN, RED, SKY, PINK, GREY)
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
    if not stages:
        raise OptionError("losses: no stage; expected the logs of a training")
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
