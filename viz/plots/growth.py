"""How a memory grew, round by round: a figure, and the same in characters for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from viz.plots.canvas import Rounds, check_rounds, chosen, figure_of, round_axis
from viz.plots.palette import COLORS, HATCHES
from viz.plots.timing import times_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Of a line of characters.
WIDTH = 72
FATES = ("added", "merged", "rejected", "new voxels")


def draw_growth(
    rounds: Rounds, *, title: str | None = None, panels: Sequence[str] | None = None
) -> Figure:
    """What is stored, what became of the points, coverage, and time.

    Args:
        rounds: the lines of a run's ``rounds.jsonl``, in order.
        title: what was reconstructed.
        panels: of "stored", "fates", "coverage" and "time"; None is all four.

    Returns:
        A figure with its own Agg canvas; no state of pyplot is touched.
    """
    check_rounds(rounds)
    known = {
        "stored": partial(stored_panel, rounds=rounds),
        "fates": partial(fates_panel, rounds=rounds),
        "coverage": partial(coverage_panel, rounds=rounds),
        "time": partial(times_panel, rounds=rounds),
    }
    heading = None if title is None else f"{title}: growth of the memory"
    return figure_of(chosen(known, panels), title=heading)


def growth_text(rounds: Rounds) -> str:
    """The growth as lines of characters: a bar of what is stored for each round, and the figures.

    Args:
        rounds: the lines of a run's ``rounds.jsonl``, in order.
    """
    check_rounds(rounds)
    scanned = any(_scanned(entry) for entry in rounds)
    legend = f"round  observations  # observed{'  : scanned' if scanned else ''}  + generated"
    head = legend.ljust(WIDTH - 18) + "coverage".rjust(18)
    room = WIDTH - 8 - 9 - 18
    largest = max(1, max(map(_total, rounds)))
    lines = [head]
    for entry in rounds:
        total = _total(entry)
        length, marks = round(room * total / largest), ""
        for mark, count in (("+", entry["generated"]), (":", _scanned(entry))):
            # What is there at all is drawn at least once.
            share = max(bool(count), round(room * count / largest))
            marks = mark * min(length - len(marks), share) + marks
        bar = "#" * (length - len(marks)) + marks
        covered = "-"
        if entry["coverage_after"] is not None:
            covered = f"{_share(entry['coverage_before'])} -> {_share(entry['coverage_after'])}"
        count = _count(total).rjust(8)
        lines.append(f"{entry['round']:>5}  {count}  {bar.ljust(room)}{covered.rjust(18)}")
    new_voxels = _new_voxels(rounds)
    for entry, voxels in zip(rounds, new_voxels, strict=True):
        text = (
            f"{entry['round']:>5}  {_count(entry['added'])} added, {_count(entry['merged'])} "
            f"merged, {_count(entry['rejected'])} rejected, {_count(voxels)} new voxels"
        )
        lines.append(text)
    return "\n".join(lines)


def _scanned(entry: Mapping[str, Any]) -> int:
    return int(entry.get("scanned", 0))


def _total(entry: Mapping[str, Any]) -> int:
    return int(entry["observed"]) + _scanned(entry) + int(entry["generated"])


def _new_voxels(rounds: Rounds) -> list[int]:
    totals = [0, *(entry["voxels"] for entry in rounds)]
    return [after - before for before, after in pairwise(totals)]


def stored_panel(axes: Axes, *, rounds: Rounds) -> None:
    """Observations by origin on top of each other, and the voxels that hold them."""
    round_axis(axes, rounds)
    at = range(len(rounds))
    observed = [entry["observed"] for entry in rounds]
    axes.bar(at, observed, color=COLORS["observed"], label="observed")
    below = observed
    further = {"scanned": [*map(_scanned, rounds)], "generated": [e["generated"] for e in rounds]}
    for name, counts in further.items():
        if name == "generated" or any(counts):
            axes.bar(
                at, counts, bottom=below, color=COLORS[name], hatch=HATCHES[name],
                edgecolor="white", linewidth=0, label=name,
            )  # fmt: skip
            below = [a + b for a, b in zip(below, counts, strict=True)]
    voxels = [entry["voxels"] for entry in rounds]
    axes.plot(at, voxels, "o-", color=COLORS["voxels"], markersize=4, label="voxels")
    axes.set_title("stored after each round")
    axes.set_ylabel("observations, voxels")
    _engineering(axes)
    axes.set_ylim(0, 1.22 * max(1, *map(_total, rounds)))
    axes.legend(ncols=4, loc="upper left", frameon=False, fontsize="small")


def fates_panel(axes: Axes, *, rounds: Rounds) -> None:
    """What became of the points that arrived in each round."""
    round_axis(axes, rounds)
    values = {name: [entry[name] for entry in rounds] for name in FATES[:3]}
    values["new voxels"] = _new_voxels(rounds)
    step = 0.8 / len(FATES)
    for k, name in enumerate(FATES):
        at = [i + (k - (len(FATES) - 1) / 2) * step for i in range(len(rounds))]
        axes.bar(
            at, values[name], step, color=COLORS[name], hatch=HATCHES.get(name),
            edgecolor="white", linewidth=0, label=name,
        )  # fmt: skip
    axes.set_title("what became of the points that arrived")
    axes.set_ylabel("points, voxels (logarithmic)")
    # Round 0 takes all the context in and would hide every later round on a linear axis.
    positive = [value for row in values.values() for value in row if value > 0]
    if positive:
        axes.set_yscale("log")
        axes.minorticks_off()
        low, high = min(positive) / 3, max(positive)
        # A share of the decades above the bars is the legend's.
        axes.set_ylim(low, high * (high / low) ** 0.25)
        _engineering(axes)
    axes.legend(
        ncols=4, loc="upper right", frameon=False, fontsize="small", handlelength=1.2,
        columnspacing=0.9,
    )  # fmt: skip


def coverage_panel(axes: Axes, *, rounds: Rounds) -> None:
    """How much of the targets the memory supports, in percent of the pixels, round by round."""
    round_axis(axes, rounds)
    axes.set_title("target pixels that the memory supports")
    axes.set_ylabel("coverage, % of pixels")
    axes.set_ylim(0, 126)
    axes.set_yticks(range(0, 101, 20))
    known = [
        (i, 100 * entry["coverage_before"], 100 * entry["coverage_after"])
        for i, entry in enumerate(rounds)
        if entry["coverage_before"] is not None and entry["coverage_after"] is not None
    ]
    if not known:
        axes.text(0.5, 0.5, "no targets", transform=axes.transAxes, ha="center")
        return
    at, before, after = zip(*known, strict=True)
    axes.vlines(at, before, after, color="#999999", linewidth=2, zorder=2)
    axes.scatter(
        at, before, s=45, color="white", edgecolor=COLORS["observed"], linewidth=1.8, zorder=3,
        label="before the round",
    )  # fmt: skip
    axes.scatter(at, after, s=45, color=COLORS["observed"], zorder=3, label="after the round")
    if len(known) <= 12:
        for x, low, high in known:
            axes.annotate(f"{high:.1f}", (x, high), (0, 6), textcoords="offset points",
                          ha="center", fontsize="small")  # fmt: skip
            if high - low > 6:
                axes.annotate(f"{low:.1f}", (x, low), (0, -13), textcoords="offset points",
                              ha="center", fontsize="small")  # fmt: skip
    axes.legend(ncols=2, loc="upper left", frameon=False, fontsize="small")


def _engineering(axes: Axes) -> None:
    from matplotlib.ticker import FuncFormatter

    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _count(value)))


def _count(value: float) -> str:
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:.3g}{name}"
    return f"{value:g}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"
