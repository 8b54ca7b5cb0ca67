"""How good the completed pictures are, round by round: whether a run drifts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError
from viz.plots.canvas import figure_of
from viz.plots.palette import BLACK, COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Views = Sequence[Mapping[str, Any]]

# Key of a view's figures: name, colour and mark.
REGIONS = {
    "psnr": ("whole", BLACK, "D"),
    "psnr_valid": ("observed", COLORS["observed"], "o"),
    "psnr_generated": ("generated", COLORS["generated"], "s"),
}


def draw_quality(views: Views, *, title: str | None = None) -> Figure:
    """PSNR against round: each target faintly, the round's mean boldly, observed and generated.

    Args:
        views: of each target ``round`` and, as far as known, ``psnr``, ``psnr_valid`` and
            ``psnr_generated``, dB.
        title: what was reconstructed.
    """
    if not is_measured(views):
        raise OptionError("quality: no target has a PSNR; expected figures of one at least")
    return figure_of([partial(_panel, views=views)], title=title)


def is_measured(views: Views) -> bool:
    """Whether any of the targets has a PSNR."""
    return any(view.get(key) is not None for view in views for key in REGIONS)


def _panel(axes: Axes, *, views: Views) -> None:
    from matplotlib.ticker import MaxNLocator

    for key, (name, color, mark) in REGIONS.items():
        of_round: dict[int, list[float]] = {}
        for view in views:
            if view.get(key) is not None:
                of_round.setdefault(view["round"], []).append(view[key])
        if not of_round:
            continue
        every = [(number, value) for number, values in of_round.items() for value in values]
        at, values = zip(*every, strict=True)
        axes.scatter(at, values, s=9, color=color, alpha=0.3, linewidth=0)
        means = sorted((number, sum(v) / len(v)) for number, v in of_round.items())
        axes.plot(*zip(*means, strict=True), marker=mark, markersize=5, color=color, label=name)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_title("pictures against the truth (dots: targets)")
    axes.set_xlabel("round")
    axes.set_ylabel("PSNR, dB")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.18 * (high - low))
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.legend(ncols=3, loc="upper left", frameon=False, fontsize="small")
