"""Accuracy against time, trial by trial, with the front that no trial beats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette; marks differ too.
STYLES = {
    "trial": {"color": "#999999", "marker": "o"},
    "combination": {"color": "#56B4E9", "marker": "s"},
    "profile": {"color": "#E69F00", "marker": "^"},
    "start": {"color": "#000000", "marker": "D"},
}


def draw_pareto(
    trials: Sequence[Mapping[str, Any]],
    *,
    front: Sequence[Mapping[str, Any]],
    recommended: Mapping[str, Any] | None = None,
    budget: float | None = None,
    title: str,
) -> Figure:
    """PSNR over seconds of a run, logarithmic, and over the memory's size.

    Args:
        trials: each with ``seconds``, ``bytes``, ``psnr``, ``label`` and ``kind`` (of STYLES).
        front: the trials that no other beats in both time and PSNR, fastest first.
        recommended: a ring around it.
        budget: seconds, a vertical line.
        title: of the scene.

    Returns:
        A figure with its own Agg canvas.

    Raises:
        OptionError: no trials.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not trials:
        raise OptionError("a trade-off without trials; expected one at least")
    figure = Figure(figsize=(11, 5), layout="constrained")
    FigureCanvasAgg(figure)
    times, sizes = figure.subplots(1, 2, sharey=True)
    for axes, key, scale in ((times, "seconds", 1.0), (sizes, "bytes", 2**20)):
        for kind, style in STYLES.items():
            chosen = [trial for trial in trials if trial["kind"] == kind]
            if chosen:
                axes.scatter(
                    [trial[key] / scale for trial in chosen],
                    [trial["psnr"] for trial in chosen],
                    label=kind,
                    s=36,
                    zorder=3,
                    **style,
                )
        if recommended is not None:
            axes.scatter(
                [recommended[key] / scale],
                [recommended["psnr"]],
                s=180,
                facecolors="none",
                edgecolors="#D55E00",
                linewidths=2,
                zorder=4,
                label="recommended",
            )
        axes.set_xscale("log")
        axes.grid(alpha=0.3)
    times.step(
        [trial["seconds"] for trial in front],
        [trial["psnr"] for trial in front],
        where="post",
        color="#0072B2",
        zorder=2,
        label="front",
    )
    if budget is not None:
        times.axvline(budget, color="#D55E00", linestyle="--", label=f"budget {budget:g} s")
    times.set_xlabel("seconds of a whole run")
    times.set_ylabel("PSNR, dB, whole pictures")
    sizes.set_xlabel("memory, MiB")
    times.legend(fontsize=8, loc="lower right")
    figure.suptitle(title)
    return figure
