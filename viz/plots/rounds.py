"""Figures of a run's rounds: growth of the memory, time by stage, quality of the pictures.

The growth is also told in characters, for a terminal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from viz.plots.canvas import BLACK, COLORS, GREY, HATCHES, LEGEND, LINES, OTHERS, Rounds, figure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Views = Sequence[Mapping[str, Any]]

# Of a line of characters.
WIDTH = 72
FATES = ("added", "merged", "rejected", "new voxels")
STAGES = ("depth", "fuse", "project", "complete", "align")
# What a round took beyond its stages: reading, writing pictures and the memory.
REST = "other"
TOTAL = "total"
# Key of a view's figures: name, colour and mark.
REGIONS = {
    "psnr": ("whole", BLACK, "D"),
    "psnr_valid": ("observed", COLORS["observed"], "o"),
    "psnr_generated": ("generated", COLORS["generated"], "s"),
}


def draw_growth(
    rounds: Rounds, *, title: str | None = None, panels: Sequence[str] | None = None
) -> Figure:
    """What is stored, what became of the points, coverage, and time.

    ``title`` names what was reconstructed; ``panels`` are of "stored", "fates", "coverage" and
    "time", None is all four.
    """
    known = {
        "stored": partial(_stored_panel, rounds=rounds),
        "fates": partial(_fates_panel, rounds=rounds),
        "coverage": partial(_coverage_panel, rounds=rounds),
        "time": partial(_times_panel, rounds=rounds),
    }
    heading = None if title is None else f"{title}: growth of the memory"
    return figure_of([known[name] for name in panels or known], title=heading)


def growth_text(rounds: Rounds) -> str:
    """The growth as lines of characters: for each round a bar of what is stored, and figures."""
    scanned = any(_scanned(entry) for entry in rounds)
    legend = f"round  observations  # observed{'  : scanned' if scanned else ''}  + generated"
    room = WIDTH - 8 - 9 - 18
    largest = max(1, max(map(_total, rounds)))
    lines = [legend.ljust(WIDTH - 18) + "coverage".rjust(18)]
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
    for entry, voxels in zip(rounds, _new_voxels(rounds), strict=True):
        lines.append(
            f"{entry['round']:>5}  {_count(entry['added'])} added, {_count(entry['merged'])} "
            f"merged, {_count(entry['rejected'])} rejected, {_count(voxels)} new voxels"
        )
    return "\n".join(lines)


def _scanned(entry: Mapping[str, Any]) -> int:
    return int(entry.get("scanned", 0))


def _total(entry: Mapping[str, Any]) -> int:
    return int(entry["observed"]) + _scanned(entry) + int(entry["generated"])


def _new_voxels(rounds: Rounds) -> list[int]:
    totals = [0, *(entry["voxels"] for entry in rounds)]
    return [after - before for before, after in pairwise(totals)]


def _round_axis(axes: Axes, rounds: Rounds) -> None:
    """The horizontal axis of a panel over rounds."""
    axes.set_xticks(range(len(rounds)), [str(entry["round"]) for entry in rounds])
    if len(rounds) > 20:
        axes.set_xticks(range(0, len(rounds), len(rounds) // 10))
    axes.set_xlim(-0.6, len(rounds) - 0.4)
    axes.set_xlabel("round")
    axes.grid(axis="y", **LINES)


def _stored_panel(axes: Axes, *, rounds: Rounds) -> None:
    """Observations by origin on top of each other, and the voxels that hold them."""
    _round_axis(axes, rounds)
    at = range(len(rounds))
    observed = [entry["observed"] for entry in rounds]
    axes.bar(at, observed, color=COLORS["observed"], label="observed")
    below = observed
    further = {"scanned": [*map(_scanned, rounds)], "generated": [e["generated"] for e in rounds]}
    for name, counts in further.items():
        if name == "generated" or any(counts):
            axes.bar(at, counts, bottom=below, **_bars(name, COLORS[name]))
            below = [a + b for a, b in zip(below, counts, strict=True)]
    voxels = [entry["voxels"] for entry in rounds]
    axes.plot(at, voxels, "o-", color=COLORS["voxels"], markersize=4, label="voxels")
    axes.set_title("stored after each round")
    axes.set_ylabel("observations, voxels")
    _engineering(axes)
    axes.set_ylim(0, 1.22 * max(1, *map(_total, rounds)))
    axes.legend(ncols=4, loc="upper left", **LEGEND)


def _fates_panel(axes: Axes, *, rounds: Rounds) -> None:
    """What became of the points that arrived in each round."""
    _round_axis(axes, rounds)
    values = {name: [entry[name] for entry in rounds] for name in FATES[:3]}
    values["new voxels"] = _new_voxels(rounds)
    step = 0.8 / len(FATES)
    for k, name in enumerate(FATES):
        at = [i + (k - (len(FATES) - 1) / 2) * step for i in range(len(rounds))]
        axes.bar(at, values[name], step, **_bars(name, COLORS[name]))
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
    axes.legend(ncols=4, loc="upper right", handlelength=1.2, columnspacing=0.9, **LEGEND)


def _coverage_panel(axes: Axes, *, rounds: Rounds) -> None:
    """How much of the targets the memory supports, in percent of the pixels, round by round."""
    _round_axis(axes, rounds)
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
    axes.vlines(at, before, after, color=GREY, linewidth=2, zorder=2)
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
    axes.legend(ncols=2, loc="upper left", **LEGEND)


def _bars(name: str, color: str) -> dict[str, Any]:
    return {
        "color": color, "hatch": HATCHES.get(name), "edgecolor": "white", "linewidth": 0,
        "label": name,
    }  # fmt: skip


def _engineering(axes: Axes) -> None:
    axes.yaxis.set_major_formatter(lambda value, _: _count(value))


def _count(value: float) -> str:
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:.3g}{name}"
    return f"{value:g}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def draw_timing(
    rounds: Rounds, *, title: str | None = None, panels: Sequence[str] | None = None
) -> Figure:
    """Seconds by stage over the whole run ("stages"), and by stage and round ("rounds")."""
    known = {
        "stages": partial(_stages_panel, rounds=rounds),
        "rounds": partial(_times_panel, rounds=rounds),
    }
    return figure_of([known[name] for name in panels or known], title=title)


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


def _stages_panel(axes: Axes, *, rounds: Rounds) -> None:
    """A horizontal bar for each stage, with its seconds and its share."""
    stages = stage_seconds(rounds)
    axes.set_title("time of the run by stage")
    axes.set_xlabel("seconds")
    totals = {stage: sum(seconds) for stage, seconds in stages.items()}
    whole, longest = sum(totals.values()), max(totals.values(), default=1e-3)
    for place, (stage, seconds) in enumerate(totals.items()):
        axes.barh(place, seconds, **_bars(stage, _color(stage, list(stages))))
        axes.annotate(
            f"{seconds:.3g} s, {seconds / whole:.0%}", (seconds, place), (4, 0),
            textcoords="offset points", va="center", fontsize="small",
        )  # fmt: skip
    axes.set_yticks(range(len(totals)), list(totals))
    axes.invert_yaxis()
    axes.set_xlim(0, 1.45 * longest)
    axes.grid(axis="x", **LINES)


def _times_panel(axes: Axes, *, rounds: Rounds) -> None:
    """For each round its stages on top of each other."""
    _round_axis(axes, rounds)
    bottom = [0.0] * len(rounds)
    stages = stage_seconds(rounds)
    for stage, seconds in stages.items():
        style = _bars(stage, _color(stage, list(stages)))
        axes.bar(range(len(rounds)), seconds, bottom=bottom, **style)
        bottom = [a + b for a, b in zip(bottom, seconds, strict=True)]
    axes.set_title("time of each round")
    axes.set_ylabel("seconds")
    axes.set_ylim(0, 1.35 * max(1e-3, *bottom))
    if stages:
        axes.legend(ncols=3, loc="upper right", handlelength=1.2, columnspacing=0.9, **LEGEND)


def _color(stage: str, stages: Sequence[str]) -> str:
    if stage in COLORS:
        return COLORS[stage]
    unnamed = [name for name in reversed(stages) if name not in COLORS]
    return OTHERS[unnamed.index(stage) % len(OTHERS)]


def draw_quality(views: Views, *, title: str | None = None) -> Figure:
    """PSNR against round: each target faintly, the round's mean boldly, observed and generated.

    Each view has its ``round`` and, as far as known, ``psnr``, ``psnr_valid`` and
    ``psnr_generated``, dB; one of them at least is known.
    """
    return figure_of([partial(_quality_panel, views=views)], title=title)


def is_measured(views: Views) -> bool:
    """Whether any of the targets has a PSNR."""
    return any(view.get(key) is not None for view in views for key in REGIONS)


def _quality_panel(axes: Axes, *, views: Views) -> None:
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
    axes.grid(axis="y", **LINES)
    axes.legend(ncols=3, loc="upper left", **LEGEND)
