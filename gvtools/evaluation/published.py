"""Benchmarks as ``data_specs/benchmarks`` records them: protocol, figures, rows as published.

A benchmark is a YAML file: its scenes and which of their views are given and completed, how each
figure is defined, what the source leaves open, and the published rows with their sources.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from importlib import resources
from typing import Annotated, Any, Literal

from pydantic import Field

from gvtools.errors import OptionError
from gvtools.evaluation.splits import SpecRecord, SplitRule
from gvtools.untrusted import parse_yaml

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


Texts = Annotated[tuple[str, ...], Field(strict=False)]


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
        for rule in self.splits:
            if views in rule.views or not rule.views:
                return rule
        raise OptionError(f"{self.name}: no split with {views} context views")


def benchmark_names() -> tuple[str, ...]:
    """The benchmarks there are, as ``load_benchmark`` takes them."""
    return tuple(_specs())


def load_benchmark(name: str) -> Benchmark:
    """A benchmark by its file's name or its printed one, however it is written."""
    specs, key = _specs(), name_key(name)
    for known, text in specs.items():
        if key == name_key(known):
            return parse_benchmark(text)
    raise OptionError(unknown("benchmark", name, specs))


def _specs() -> dict[str, str]:
    """The specifications' texts by their files' names."""
    entries = resources.files("data_specs").joinpath("benchmarks").iterdir()
    texts = {x.name[:-5]: x.read_text(encoding="utf-8") for x in entries if x.name[-5:] == ".yaml"}
    return dict(sorted(texts.items()))


def parse_benchmark(text: str) -> Benchmark:
    """A benchmark from its YAML."""
    try:
        return _benchmark(parse_yaml(text))
    except KeyError as error:
        raise OptionError(f"benchmark: no key {error}; expected protocol, figures ...") from None
    except (ValueError, TypeError, AttributeError, IndexError) as error:
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


def unknown(what: str, given: object, known: Iterable[str]) -> str:
    """A message that names the nearest of the known names."""
    near = difflib.get_close_matches(str(given), list(known), n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
    return f"{what} {given!r} is unknown; {hint}"


def name_key(text: str) -> str:
    """Letters and digits alone, so that Mip-NeRF 360 is mipnerf360."""
    return "".join(sign for sign in text.casefold() if sign.isalnum())
