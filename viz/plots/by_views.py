"""Accuracy over the number of context views, method by method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from viz.plots.canvas import figure_of
from viz.plots.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PINK, RED, SKY

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Number of context views, mean, lower and upper end of its interval.
Point = tuple[int, float, float | None, float | None]
# Side by side, so that intervals of one number of views do not hide each other; views.
APART = 0.12
STYLES = tuple(zip((BLUE, ORANGE, GREEN, RED, SKY, PINK, BLACK, GREY), "os^vDPX*", strict=True))


def draw_by_views(lines: Mapping[str, Sequence[Point]], *, label: str = "PSNR [dB]") -> Figure:
    """A line a method, with the interval of each mean.

    Args:
        lines: points by the method's name.
        label: of the vertical axis.

    Returns:
        A figure with its own Agg canvas.
    """

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
