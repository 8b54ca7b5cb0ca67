"""Where a run's time went: a bar for each stage, and each round's stages on top of each other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from viz.plots.canvas import Rounds, check_rounds, chosen, figure_of, round_axis
from viz.plots.palette import COLORS, HATCHES, OTHERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STAGES = ("depth", "fuse", "project", "complete", "align")
# What a round took beyond its stages: reading, writing pictures and the memory.
REST = "other"
TOTAL = "total"


def draw_timing(
    rounds: Rounds, *, title: str | None = None, panels: Sequence[str] | None = None
) -> Figure:
    """Seconds by stage over the whole run ("stages"), and by stage and round ("rounds").

    Args:
        rounds: the lines of a run's ``rounds.jsonl``, in order.
        title: what was reconstructed.
        panels: of "stages" and "rounds"; None is both.
    """
    check_rounds(rounds)
    known = {
        "stages": partial(stages_panel, rounds=rounds),
        "rounds": partial(times_panel, rounds=rounds),
    }
    return figure_of(chosen(known, panels), title=title)


def stage_seconds(rounds: Rounds) -> dict[str, list[float]]:
    """For each stage that took time, in order, its seconds in each round; REST comes last."""
    named = dict.fromkeys(STAGES)
    for entry in rounds:
        named |= dict.fromkeys(stage for stage in entry["seconds"] if stage != TOTAL)
    out = {stage: [float(entry["seconds"].get(stage) or 0) for entry in rounds] for stage in named}
    spent = [sum(seconds) for seconds in zip(*out.values(), strict=True)]
    out[REST] = [
        max(0.0, float(entry["seconds"].get(TOTAL) or 0) - known)
        for entry, known in zip(rounds, spent, strict=True)
    ]
    return {stage: seconds for stage, seconds in out.items() if any(seconds)}


def stages_panel(axes: Axes, *, rounds: Rounds) -> None:
    """A horizontal bar for each stage, with its seconds and its share."""
    stages = stage_seconds(rounds)
    axes.set_title("time of the run by stage")
    axes.set_xlabel("seconds")
    totals = {stage: sum(seconds) for stage, seconds in stages.items()}
    whole, longest = sum(totals.values()), max(totals.values(), default=1e-3)
    for place, (stage, seconds) in enumerate(totals.items()):
        axes.barh(
            place, seconds, color=_color(stage, list(stages)), hatch=HATCHES.get(stage),
            edgecolor="white", linewidth=0,
        )  # fmt: skip
        axes.annotate(
            f"{seconds:.3g} s, {seconds / whole:.0%}", (seconds, place), (4, 0),
            textcoords="offset points", va="center", fontsize="small",
        )  # fmt: skip
    axes.set_yticks(range(len(totals)), list(totals))
    axes.invert_yaxis()
    axes.set_xlim(0, 1.45 * longest)
    axes.grid(axis="x", color="#dddddd", linewidth=0.6)


def times_panel(axes: Axes, *, rounds: Rounds) -> None:
    """For each round its stages on top of each other."""
    round_axis(axes, rounds)
    bottom = [0.0] * len(rounds)
    stages = stage_seconds(rounds)
    for stage, seconds in stages.items():
        axes.bar(
            range(len(rounds)), seconds, bottom=bottom, color=_color(stage, list(stages)),
            hatch=HATCHES.get(stage), edgecolor="white", linewidth=0, label=stage,
        )  # fmt: skip
        bottom = [a + b for a, b in zip(bottom, seconds, strict=True)]
    axes.set_title("time of each round")
    axes.set_ylabel("seconds")
    axes.set_ylim(0, 1.35 * max(1e-3, *bottom))
    if stages:
        axes.legend(
            ncols=3, loc="upper right", frameon=False, fontsize="small",
            handlelength=1.2, columnspacing=0.9,
        )  # fmt: skip


def _color(stage: str, stages: Sequence[str]) -> str:
    if stage in COLORS:
        return COLORS[stage]
    unnamed = [name for name in reversed(stages) if name not in COLORS]
    return OTHERS[unnamed.index(stage) % len(OTHERS)]
