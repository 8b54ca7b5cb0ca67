"""How a memory grew, round by round: a figure, and the same in characters for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Rounds = Sequence[Mapping[str, Any]]

# Okabe and Ito's palette, which the common forms of colour blindness tell apart.
COLORS = {
    "observed": "#0072B2",
    "generated": "#E69F00",
    "voxels": "#000000",
    "added": "#009E73",
    "merged": "#56B4E9",
    "rejected": "#D55E00",
    "new voxels": "#999999",
    "depth": "#0072B2",
    "fuse": "#009E73",
    "project": "#56B4E9",
    "complete": "#E69F00",
    "align": "#CC79A7",
}
HATCHES = {"generated": "//", "rejected": "xx", "merged": "..", "complete": "//", "align": "xx"}
STAGES = ("depth", "fuse", "project", "complete", "align")
FATES = ("added", "merged", "rejected", "new voxels")


def draw_growth(rounds: Rounds, *, title: str) -> Figure:
    """Four panels: what is stored, what became of the points, coverage, and time.

    Args:
        rounds: the lines of a run's ``rounds.jsonl``, in order.
        title: what was reconstructed.

    Returns:
        A figure with its own Agg canvas; no state of pyplot is touched.

    Raises:
        OptionError: no rounds.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    _check(rounds)
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    (stored, fates), (coverage, times) = figure.subplots(2, 2)
    _draw_stored(stored, rounds)
    _draw_fates(fates, rounds)
    _draw_coverage(coverage, rounds)
    _draw_times(times, rounds)
    for axes in (stored, fates, coverage, times):
        axes.set_xticks(range(len(rounds)), [str(entry["round"]) for entry in rounds])
        axes.set_xlim(-0.6, len(rounds) - 0.4)
        axes.set_xlabel("round")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
        if len(rounds) > 20:
            axes.set_xticks(range(0, len(rounds), len(rounds) // 10))
    figure.suptitle(f"{title}: growth of the memory")
    return figure


def growth_text(rounds: Rounds, width: int = 72) -> str:
    """The growth as lines of characters: a bar of what is stored for each round, and the figures.

    Args:
        rounds: the lines of a run's ``rounds.jsonl``, in order.
        width: of a line, at least 60 characters.

    Raises:
        OptionError: no rounds, or a width below 60.
    """
    _check(rounds)
    if width < 60:
        raise OptionError(f"growth: {width} characters wide; expected 60 or more")
    legend = "round  observations  # observed  + generated"
    head = legend.ljust(width - 18) + "coverage".rjust(18)
    room = width - 8 - 9 - 18
    largest = max(1, max(entry["observed"] + entry["generated"] for entry in rounds))
    lines = [head]
    for entry in rounds:
        total = entry["observed"] + entry["generated"]
        length = round(room * total / largest)
        # What is there at all is drawn at least once.
        plus = min(
            length, max(bool(entry["generated"]), round(room * entry["generated"] / largest))
        )
        bar = "#" * (length - plus) + "+" * plus
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


def _check(rounds: Rounds) -> None:
    if not rounds:
        raise OptionError("growth: no rounds; expected the lines of a run's rounds.jsonl")


def _new_voxels(rounds: Rounds) -> list[int]:
    totals = [0, *(entry["voxels"] for entry in rounds)]
    return [after - before for before, after in pairwise(totals)]


def _draw_stored(axes: Axes, rounds: Rounds) -> None:
    at = range(len(rounds))
    observed = [entry["observed"] for entry in rounds]
    generated = [entry["generated"] for entry in rounds]
    axes.bar(at, observed, color=COLORS["observed"], label="observed")
    axes.bar(
        at, generated, bottom=observed, color=COLORS["generated"], hatch=HATCHES["generated"],
        edgecolor="white", linewidth=0, label="generated",
    )  # fmt: skip
    voxels = [entry["voxels"] for entry in rounds]
    axes.plot(at, voxels, "o-", color=COLORS["voxels"], markersize=4, label="voxels")
    axes.set_title("stored after each round")
    axes.set_ylabel("observations, voxels")
    _engineering(axes)
    axes.set_ylim(0, 1.22 * max(1, *(a + b for a, b in zip(observed, generated, strict=True))))
    axes.legend(ncols=3, loc="upper left", frameon=False, fontsize="small")


def _draw_fates(axes: Axes, rounds: Rounds) -> None:
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
        axes.set_ylim(min(positive) / 3, max(positive) * 8)
        _engineering(axes)
    axes.legend(ncols=4, loc="upper right", frameon=False, fontsize="small")


def _draw_coverage(axes: Axes, rounds: Rounds) -> None:
    axes.set_title("target pixels that the memory supports")
    axes.set_ylabel("coverage, % of pixels")
    axes.set_ylim(0, 119)
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


def _draw_times(axes: Axes, rounds: Rounds) -> None:
    bottom = [0.0] * len(rounds)
    for stage in STAGES:
        seconds = [float(entry["seconds"].get(stage) or 0) for entry in rounds]
        if not any(seconds):
            continue
        axes.bar(
            range(len(rounds)), seconds, bottom=bottom, color=COLORS[stage],
            hatch=HATCHES.get(stage), edgecolor="white", linewidth=0, label=stage,
        )  # fmt: skip
        bottom = [a + b for a, b in zip(bottom, seconds, strict=True)]
    axes.set_title("time")
    axes.set_ylabel("seconds")
    axes.set_ylim(0, 1.22 * max(1e-3, *bottom))
    if any(bottom):
        axes.legend(ncols=5, loc="upper left", frameon=False, fontsize="small")


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
