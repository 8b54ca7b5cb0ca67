"""Published benchmarks (``data_specs/benchmarks``): splits of scenes, ranks among their rows.

A benchmark is a YAML file: its scenes and which of their views are given and completed, how each
figure is defined, what the source leaves open, and the published rows with their sources.

A measured row joins the ranking figure by figure, where its data set, its scenes, its resolution,
its views and the figure's definition are those of the source. What the source leaves open and the
value depends on (such as the network of LPIPS) agrees with nothing.

The protocol's rule: a round has two context views and six target views; long sequences have three
rounds. The source publishes neither its scenes' views nor how they were chosen, so this is a rule
of our own, and every split is written beside its scores:

1. A window of context + targets * rounds views, ``stride`` views apart, begins at a view drawn from
   ``seed`` among all that let it end inside the scene.
2. One round, to interpolate (layout "ends"): the context is spread evenly over the window, its
   first and last view included; the views between them are the targets. Several rounds, to
   extrapolate (layout "first"): the context comes first, the targets follow.
3. The targets, in the scene's order, are cut into rounds of equal size.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, model_validator

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.tables import Column, Ranked, Table, Value
from gvtools.specs import SpecRecord, Texts, name_key, spec_file, spec_texts
from gvtools.untrusted import parse_yaml, read_json

Aspect = Literal[
    "pixels", "mask", "ssim", "lpips_net", "poses_from", "pose_unit", "reprojection", "met3r",
    "hardware",
]  # fmt: skip
# What a definition may ask of a setting: its field, and how it is called in a reason.
ASPECTS: dict[Aspect, str] = {
    "pixels": "compared pixels",
    "mask": "object mask",
    "ssim": "SSIM",
    "lpips_net": "LPIPS network",
    "poses_from": "poses from",
    "pose_unit": "unit of translations",
    "reprojection": "reprojection error",
    "met3r": "MEt3R",
    "hardware": "hardware",
}
PUBLISHED = "published"
MEASURED = "measured here"
NO_VALUE = "no value here"
Item = TypeVar("Item")
NOTHING_COMPARABLE = "published rows: none that is comparable has a value"


Numbers = Annotated[tuple[int, ...], Field(strict=False)]


class SplitRule(SpecRecord):
    """A rule, and where it is cited from."""

    # "every": each K-th view is a target, the context is spread evenly over the others. "listed":
    # numbers of views, the first ones of the context. "files": a file beside the scene's pictures.
    # "protocol": ``protocol_split``.
    kind: Literal["every", "listed", "files", "protocol"]
    views: Numbers = ()  # the numbers of context views that it serves; empty for all
    every: int | None = Field(None, ge=2)  # K of "every"
    # Of "listed", numbers from 0 on in the scene's order; the first N are given.
    context: Numbers = ()
    targets: Numbers = ()  # of "listed"
    # Of "files", in the scene's folder; {views} stands for the number of context views. It holds
    # ``train_ids`` and ``test_ids``, numbers of the frames of ``transforms.json``.
    file: str = ""
    # Folder of the data set's own reduced pictures, which are read where they are there.
    copies: str = ""
    # What the width and height of the recorded pictures are divided by; None leaves them, or takes
    # the benchmark's resolution.
    divided_by: int | None = Field(None, ge=1)
    # Of "protocol", views from one of the window to the next; None takes the widest.
    stride: int | None = Field(None, ge=1)
    source: str  # where the rule is from

    @model_validator(mode="after")
    def _complete(self) -> SplitRule:
        needed = {"every": (self.every,), "listed": (self.context, self.targets),
                  "files": (self.file,), "protocol": ()}  # fmt: skip
        if not all(needed[self.kind]):
            raise ValueError(f"a split of kind {self.kind} lacks what tells its views")
        return self


class Figure(SpecRecord):
    """A measure as the source has it."""

    name: str  # key, such as ``rpe_r``
    label: str  # as printed
    better: Literal["higher", "lower"]  # "higher" or "lower"
    digits: int  # decimals of the published values
    # What a measurement has to share, by the names of ASPECTS; None where the source does not state
    # it.
    definition: dict[Aspect, str | None]
    stated: str  # what the source says
    not_stated: Texts  # what it leaves open
    unit: str = ""  # of the values; empty for none, or for one that is not stated

    @property
    def column(self) -> Column:
        """The figure's column in tables."""
        return Column(self.label, unit=self.unit, better=self.better, digits=self.digits)


class PublishedRow(SpecRecord):
    """What a source reports of one system."""

    system: str  # its name
    figures: dict[str, float | None]  # by name; None for one that the source does not report
    # Number of context views; None where the benchmark has one number alone.
    views: int | None = None
    source: str = ""  # name of the publication that reports it, in ``Benchmark.sources``
    # How it departs from the protocol, so that it has no rank; empty where it does not.
    differs: str = ""


class Publication(SpecRecord):
    """Title of the publication, its table, and where that was read."""

    title: str  # of the publication
    table: str  # where in it
    read_in: str = ""  # which copy the rows were taken from; empty for the publication itself


class DataSet(SpecRecord):
    """Citation, role, licence and where to get it, in words."""

    cited_as: str  # key of the citation, or authors and year
    role: str  # what it serves for
    licence: str  # on what terms
    obtain: str  # from where
    spec: str = ""  # its name in ``data_specs/data_sets``; empty for projects of the user's own


class Benchmark(SpecRecord):
    """A published table with its protocol."""

    name: str  # of the data set, as printed
    # Width and height, pixels; None where pictures have several sizes, which then follow from the
    # split's ``divided_by``.
    resolution: Annotated[tuple[int, int] | None, Field(strict=False)]
    # The numbers of context views that it is run with.
    views: Annotated[tuple[int, ...], Field(strict=False)]
    context: int  # context views of a round
    targets: int | None  # target views of a round; None for all that a scene's split holds out
    rounds: int  # how many rounds
    # Which views are given and completed; each serves some of ``views``.
    splits: Annotated[tuple[SplitRule, ...], Field(strict=False)]
    scenes: Texts = ()  # their names in the data set; empty for all that are there
    # Where object masks may lie below the root: {scene}, and {index}, the view's number from 0 on;
    # empty where whole pictures are compared alone.
    masks: Texts = ()
    figures: dict[str, Figure]  # by name, in the table's order
    # One a system and number of context views, in the table's order.
    rows: Annotated[tuple[PublishedRow, ...], Field(strict=False)]
    # Where rows are published, by the rows' names for it; "" is the only one.
    sources: dict[str, Publication]
    data_set: DataSet  # what is measured on
    stated: Texts  # what the source says of the protocol
    not_stated: Texts  # what it leaves open there
    notes: Texts  # what does not fit together in the source

    @property
    def source(self) -> Publication:
        """The publication, of a benchmark with one."""
        return next(iter(self.sources.values()))

    def at(self, views: int) -> Benchmark:
        """The same with one number of context views, and with the rows of that number."""
        if views not in self.views:
            listed = ", ".join(map(str, self.views))
            raise OptionError(f"{self.name} with {views} context views; expected one of {listed}")
        rows = tuple(row for row in self.rows if row.views in (None, views))
        return self.model_copy(update={"context": views, "views": (views,), "rows": rows})

    def split_of(self, views: int) -> SplitRule:
        """The rule that chooses views where so many are given."""
        return next(rule for rule in self.splits if views in rule.views or not rule.views)


def benchmark_names() -> tuple[str, ...]:
    """The benchmarks there are, as ``load_benchmark`` takes them."""
    return tuple(spec_texts("benchmarks"))


def load_benchmark(name: str) -> Benchmark:
    """A benchmark by its file's name or its printed one, however it is written."""
    texts = spec_texts("benchmarks")
    return parse_benchmark(texts[spec_file("benchmark", name, texts)])


def parse_benchmark(text: str) -> Benchmark:
    """A benchmark from its YAML."""
    try:
        return _benchmark(parse_yaml(text))
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise OptionError(f"benchmark: {error}") from None


def _benchmark(data: dict[str, Any]) -> Benchmark:
    protocol, published = data.pop("protocol"), data.pop("published")
    if "context" in protocol:
        protocol["views"] = [protocol["context"]]
    else:
        protocol["context"] = protocol["views"][0]
    if "source" in data:
        data["sources"] = {"": data.pop("source")}
    figures = {name: {"name": name, **figure} for name, figure in data["figures"].items()}
    rows = _rows(published["columns"], published["rows"], names=list(figures))
    benchmark = Benchmark.model_validate({**data, **protocol, "figures": figures, "rows": rows})
    foreign = {row.source for row in benchmark.rows} - set(benchmark.sources)
    if foreign:
        raise ValueError(f"published.rows: sources {sorted(foreign)} are not under sources")
    return benchmark


def _rows(columns: list[str], rows: list[list[Any]], *, names: list[str]) -> list[dict[str, Any]]:
    """Rows by the names of their columns: of the row itself, then the figures in their order."""
    own = [name for name in columns if name not in names]
    if columns != [*own, *names] or not {"system"} <= set(own) <= {*PublishedRow.model_fields}:
        raise ValueError(f"published.columns: {columns}; expected system, {names}")
    named = [dict(zip(columns, row, strict=True)) for row in rows]
    return [
        {**{name: row[name] for name in own}, "figures": {name: row[name] for name in names}}
        for row in named
    ]


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


def common(values: Iterable[Item]) -> Item | None:
    """The value that all are; None of several: what is mixed is none of the published."""
    different = set(values)
    return different.pop() if len(different) == 1 else None


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
    columns += [figure.column for figure in figures]
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


@dataclass(frozen=True)
class SceneSplit:
    """Views of one scene that are given, and those that are completed."""

    context: tuple[str, ...]  # names of the given views, in the scene's order
    # Names of the targets, round by round; one round where their number is open.
    rounds: tuple[tuple[str, ...], ...]
    # Of the protocol's: layout ("ends" or "first"), stride and start of the window in the scene's
    # views, how many views the scene has, and the seed that the start was drawn from.
    window: Mapping[str, Any] = field(default_factory=dict)

    @property
    def targets(self) -> tuple[str, ...]:
        """The targets of all rounds, in order."""
        return tuple(name for names in self.rounds for name in names)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        rounds = [list(names) for names in self.rounds]
        return {"context": list(self.context), "rounds": rounds, **self.window}


def split_scene(
    rule: SplitRule,
    names: Sequence[str],
    *,
    views: int,
    targets: int | None = None,
    rounds: int = 1,
    folder: Path = Path(),
) -> SceneSplit:
    """The views of a scene that a rule gives and completes.

    The scene's folder is read for "files"; targets of a round and rounds are of "protocol".

    >>> rule = SplitRule(kind="every", every=8, source="RegNeRF")
    >>> split = split_scene(rule, [f"{i:02d}" for i in range(20)], views=3)
    >>> split.context, split.targets
    (('01', '10', '19'), ('00', '08', '16'))
    """
    if rule.kind == "protocol":
        return protocol_split(
            names, context=views, targets=targets or 6, rounds=rounds, stride=rule.stride
        )
    if rule.kind == "every":
        step = rule.every or 8
        others = [i for i in range(len(names)) if i % step]
        if views > len(others):
            raise OptionError(
                f"{len(names)} views, of which {len(others)} are no targets; expected at least "
                f"{views}; give fewer --views"
            )
        # Halves are rounded to even numbers, as in the code that the split is cited from.
        rows = [round(place) for place in np.linspace(0, len(others) - 1, views).tolist()]
        given, held = [others[row] for row in rows], list(range(0, len(names), step))
    elif rule.kind == "listed":
        given, held = sorted(rule.context[:views]), list(rule.targets)
    else:
        return _from_file(rule, names, folder=folder, views=views)
    if max([*given, *held]) >= len(names) or len(given) < views:
        raise OptionError(
            f"{len(names)} views; expected at least {max([*given, *held]) + 1}, of which {views} "
            "are given; the scene may be incomplete"
        )
    return SceneSplit(tuple(names[i] for i in given), (tuple(names[i] for i in held),))


def _from_file(rule: SplitRule, names: Sequence[str], *, folder: Path, views: int) -> SceneSplit:
    path = folder / rule.file.format(views=views)
    by_name = {PurePosixPath(name).name: name for name in names}
    try:
        split, frames = read_json(path), read_json(folder / "transforms.json")["frames"]
        files = [PurePosixPath(frame["file_path"]).name for frame in frames]
        given, held = (
            tuple(by_name[files[i]] for i in split[key]) for key in ("train_ids", "test_ids")
        )
    except (OSError, LookupError, TypeError, ValueError) as error:
        raise ProjectError(
            f"{path}: unreadable, or train_ids and test_ids do not fit the views ({error}); "
            "expected the released file, with numbers of the frames of transforms.json"
        ) from None
    return SceneSplit(given, (held,))


def protocol_split(
    names: Sequence[str],
    *,
    context: int = 2,
    targets: int = 6,
    rounds: int = 1,
    stride: int | None = None,
    seed: int = 0,
) -> SceneSplit:
    """The split of a scene by the protocol's rule; the targets are those of a round.

    Without a stride, it is as wide as the scene allows. In a video's many frames that leaves the
    views little in common; give a number there. The same seed takes about the same part of any
    scene.
    """
    if stride is not None and stride < 1:
        raise OptionError(f"stride {stride}; expected at least 1")
    layout = "ends" if rounds == 1 else "first"
    window = context + targets * rounds
    if stride is None:
        stride = max((len(names) - 1) // (window - 1), 1)
    places = len(names) - (window - 1) * stride
    if places < 1:
        raise OptionError(
            f"{len(names)} views; expected at least {(window - 1) * stride + 1} for {context} "
            f"context and {rounds} x {targets} target views, {stride} apart; take a smaller "
            "stride, fewer rounds or fewer targets"
        )
    # Python promises this draw to be the same in every version, as NumPy does not.
    start = int(random.Random(seed).random() * places)
    chosen = [names[start + i * stride] for i in range(window)]
    if layout == "first" or context == 1:
        given = list(range(context))
    else:
        given = [i * (window - 1) // (context - 1) for i in range(context)]
    left = [name for i, name in enumerate(chosen) if i not in given]
    return SceneSplit(
        context=tuple(chosen[i] for i in given),
        rounds=tuple(tuple(left[r * targets : (r + 1) * targets]) for r in range(rounds)),
        window={
            "layout": layout,
            "stride": stride,
            "start": start,
            "views": len(names),
            "seed": seed,
        },
    )
