"""Conditions under which a measurement is ranked beside published figures.

A measured row joins the ranking figure by figure, where its data set, its scenes, its resolution,
its views and the figure's definition are those of the source. What the source leaves open and the
value depends on (such as the network of LPIPS) agrees with nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gvtools.evaluation.published import ASPECTS, Benchmark, Figure, PublishedRow, name_key
from gvtools.evaluation.tables import Column, Ranked, Table, Value

PUBLISHED = "published"
MEASURED = "measured here"
NO_VALUE = "no value here"
NOTHING_COMPARABLE = "published rows: none that is comparable has a value"


@dataclass(frozen=True, kw_only=True)
class Setting:
    """How figures were measured here. None is "not recorded", and agrees with nothing."""

    data_set: str | None  # a benchmark's name; None is a scene of the user's own
    resolution: tuple[int, int] | None  # width and height, pixels
    context: int | None  # context views of a round; None, here and below, when the runs differ
    targets: int | None  # target views of a round
    rounds: int | None = 1  # how many rounds
    scenes: int = 1  # how many scenes the figures are averages over
    failed: int = 0  # how many more were to be measured, and have no figures
    # Name of the benchmark whose rule chose the views; None is another choice.
    split: str | None = None
    divided_by: int | None = None  # what the recorded width and height were divided by
    pixels: str = "all"  # which pixels were compared, "all" or a region's name
    # What object masks were of, where figures were taken within them: "object".
    mask: str | None = None
    ssim: str | None = "Gaussian 11x11"  # window of SSIM
    lpips_net: str | None = None  # "vgg" or "alex"
    poses_from: str | None = None  # what estimated the poses of the pictures: "VGGT", "pose probe"
    pose_unit: str | None = None  # of ATE and RPE_t: "data set", or what they are a share of
    reprojection: str | None = None  # which reprojection error
    met3r: str | None = None  # "original" for the authors' program, else what stands in for it
    hardware: str | None = None  # what the time was taken on


@dataclass(frozen=True)
class MeasuredRow:
    """What was measured here; None and NaN are figures without a value."""

    system: str
    figures: Mapping[str, float | None]
    setting: Setting


@dataclass(frozen=True)
class SideBySideRow:
    """A system's row of the comparison; everything by the benchmark's names of figures."""

    system: str  # name
    origin: str  # PUBLISHED or MEASURED
    figures: Mapping[str, float | None]  # values; None for none
    ranks: Mapping[str, int | None]  # 1 is best; None without a rank
    reasons: Mapping[str, tuple[str, ...]]  # for each figure without a rank, why


def reasons_not_to_rank(setting: Setting, benchmark: Benchmark, figure: str) -> tuple[str, ...]:
    """Why a figure measured in ``setting`` has no rank among the published; empty if it has one."""
    reasons: list[str] = []
    if setting.data_set is None or name_key(setting.data_set) != name_key(benchmark.name):
        own = setting.data_set or "a scene of one's own"
        reasons = [f"data set: {own} here, {benchmark.name} published"]
    elif setting.scenes < 2:
        reasons = ["scenes: a single one here, the published figures are of a data set"]
    elif benchmark.scenes and setting.scenes != len(benchmark.scenes):
        reasons = [f"scenes: {setting.scenes} here, {len(benchmark.scenes)} published"]
    if benchmark.split_of(benchmark.context).kind == "protocol":
        # Scenes and views that the source does not tell cannot be the same here.
        reasons.append("views: an own choice here, not stated by the source")
    if setting.failed:
        reasons.append(f"scenes: {setting.failed} without figures here")
    divided_by = benchmark.split_of(benchmark.context).divided_by
    compared: dict[str, tuple[object, object]] = {
        "resolution": (_size(setting.resolution), _size(benchmark.resolution)),
        "resolution divided by": (setting.divided_by, divided_by),
        "context views a round": (setting.context, benchmark.context),
        "target views a round": (setting.targets, benchmark.targets),
        "rounds": (setting.rounds, benchmark.rounds),
    }
    if benchmark.targets is None:
        # The number follows from the split, which has to be the benchmark's own.
        del compared["target views a round"], compared["rounds"]
        if setting.split is None or name_key(setting.split) != name_key(benchmark.name):
            reasons.append("views: another choice here than the benchmark's")
    if benchmark.resolution is None:
        del compared["resolution"]
    else:
        del compared["resolution divided by"]
    for what, (here, there) in compared.items():
        if here != there:
            reasons.append(f"{what}: {here or 'mixed'} here, {there} published")
    for aspect, there in benchmark.figures[figure].definition.items():
        here = getattr(setting, aspect)
        if there is None or here is None or name_key(here) != name_key(there):
            stated = "not stated by the source" if there is None else f"{there} published"
            reasons.append(f"{ASPECTS[aspect]}: {here or 'not recorded'} here, {stated}")
    return tuple(reasons)


def _size(resolution: tuple[int, int] | None) -> str | None:
    return f"{resolution[0]}x{resolution[1]}" if resolution else None


def side_by_side(
    measured: Sequence[MeasuredRow], benchmark: Benchmark
) -> tuple[SideBySideRow, ...]:
    """Published rows, then measured ones, with ranks figure by figure where they are comparable.

    Where rows are published but none of them is comparable, measured ones have no rank either: the
    first of themselves would stand beside better values. Values are compared as published, in so
    many decimals; equal ones share a rank.
    """
    rows: list[PublishedRow | MeasuredRow] = [*benchmark.rows, *measured]
    why = [_reasons(row, benchmark) for row in rows]
    ranks = {}
    for name, figure in benchmark.figures.items():
        published = zip(benchmark.rows, why, strict=False)
        if benchmark.rows and all(name in w or r.figures[name] is None for r, w in published):
            for reasons in why[len(benchmark.rows) :]:
                reasons.setdefault(name, (NOTHING_COMPARABLE,))
        pairs = zip(rows, why, strict=True)
        values = [None if name in w else r.figures.get(name) for r, w in pairs]
        ranks[name] = _ranks(values, figure)
    return tuple(
        SideBySideRow(
            row.system,
            MEASURED if isinstance(row, MeasuredRow) else PUBLISHED,
            {name: row.figures.get(name) for name in ranks},
            {name: column[i] for name, column in ranks.items()},
            why[i],
        )
        for i, row in enumerate(rows)
    )


def comparison_table(rows: Sequence[SideBySideRow], benchmark: Benchmark) -> Table:
    """The rows as a table; why values have no rank stands in its notes."""
    figures = benchmark.figures.values()
    columns = [Column("System"), Column("Origin")]
    columns += [Column(f.label, unit=f.unit, better=f.better, digits=f.digits) for f in figures]
    cells: list[tuple[Value, ...]] = [
        (
            row.system,
            row.origin,
            *(Ranked(row.figures[f.name], row.ranks[f.name]) for f in figures),
        )
        for row in rows
    ]
    return Table(
        tuple(columns),
        tuple(cells),
        caption=benchmark.name,
        notes=comparison_notes(rows, benchmark),
    )


def comparison_notes(rows: Sequence[SideBySideRow], benchmark: Benchmark) -> tuple[str, ...]:
    """Where published rows are from, what their source leaves open, and why values have no rank."""
    figures = benchmark.figures.values()
    notes = []
    for name, source in benchmark.sources.items():
        of = [row.system for row in benchmark.rows if row.source == name]
        if of:
            systems = f" ({', '.join(dict.fromkeys(of))})" if name else ""
            copy = f", read in {source.read_in}" if source.read_in else ""
            notes.append(f"Published{systems}: {source.title}, {source.table}{copy}.")
    if benchmark.not_stated and notes:
        notes.append(f"Not stated there: {'; '.join(benchmark.not_stated)}.")
    where = "In the source" if len(benchmark.sources) == 1 else "In the sources"
    notes += [f"{where}, {note}." for note in benchmark.notes]
    notes.append("Ranks count the published rows, and the comparable ones that were measured here.")
    for row in rows:
        labels: dict[str, list[str]] = {}
        for figure in figures:
            for reason in row.reasons.get(figure.name, ()):
                labels.setdefault(reason, []).append(figure.label)
        labels.pop(NO_VALUE, None)
        for reason, of in labels.items():
            notes.append(f"{row.system}, no rank in {', '.join(of)}: {reason}.")
    return tuple(notes)


def _reasons(row: PublishedRow | MeasuredRow, benchmark: Benchmark) -> dict[str, tuple[str, ...]]:
    """For each figure without a rank, why."""
    if isinstance(row, PublishedRow):
        return dict.fromkeys(benchmark.figures, (row.differs,)) if row.differs else {}
    out: dict[str, tuple[str, ...]] = {}
    for name in benchmark.figures:
        value = row.figures.get(name)
        absent = value is None or math.isnan(value)
        out[name] = (NO_VALUE,) if absent else reasons_not_to_rank(row.setting, benchmark, name)
    return {name: reasons for name, reasons in out.items() if reasons}


def _ranks(values: Sequence[float | None], figure: Figure) -> list[int | None]:
    """Of the values, rounded as published: no digit decides that others do not have."""
    sign = 1 if figure.better == "higher" else -1
    worth = [None if value is None else sign * round(value, figure.digits) for value in values]
    known = [value for value in worth if value is not None]
    return [None if own is None else 1 + sum(other > own for other in known) for own in worth]
