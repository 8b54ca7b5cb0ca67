"""Published figures of a benchmark, as ``data_specs/benchmarks`` records them.

A benchmark is a YAML file: its protocol, how each figure is defined, what the source leaves open,
and the rows as published.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from importlib import resources
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from gvtools.errors import OptionError

Aspect = Literal[
    "pixels", "lpips_net", "poses_from", "pose_unit", "reprojection", "met3r", "hardware"
]
# What a definition may ask of a setting: its field, and how it is called in a reason.
ASPECTS: dict[Aspect, str] = {
    "pixels": "compared pixels",
    "lpips_net": "LPIPS network",
    "poses_from": "poses from",
    "pose_unit": "unit of translations",
    "reprojection": "reprojection error",
    "met3r": "MEt3R",
    "hardware": "hardware",
}


class _Record(BaseModel):
    """Part of a specification: exactly these keys, of exactly these types."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


Texts = Annotated[tuple[str, ...], Field(strict=False)]


class Figure(_Record):
    """A measure as the source has it.

    Attributes:
        name: key, such as ``rpe_r``.
        label: as printed.
        better: "higher" or "lower".
        digits: decimals of the published values.
        definition: what a measurement has to share, by the names of ASPECTS; None where the source
            does not state it.
        stated: what the source says.
        not_stated: what it leaves open.
        unit: of the values; empty for none, or for one that is not stated.
    """

    name: str
    label: str
    better: Literal["higher", "lower"]
    digits: int
    definition: dict[Aspect, str | None]
    stated: str
    not_stated: Texts
    unit: str = ""


class PublishedRow(_Record):
    """What the source reports of one system: every figure, by name."""

    system: str
    figures: dict[str, float]


class Source(_Record):
    """Title of the publication, and its table."""

    title: str
    table: str


class DataSet(_Record):
    """Citation, role, licence and where to get it, in words."""

    cited_as: str
    role: str
    licence: str
    obtain: str


class Benchmark(_Record):
    """A published table with its protocol.

    Attributes:
        name: of the data set, as printed.
        resolution: width and height, pixels.
        context: context views of a round.
        targets: target views of a round.
        rounds: how many rounds.
        figures: by name, in the table's order.
        rows: one a system, in the table's order.
        source: where it is published.
        data_set: what was measured on.
        stated: what the source says of the protocol.
        not_stated: what it leaves open there.
        notes: what does not fit together in the source.
    """

    name: str
    resolution: Annotated[tuple[int, int], Field(strict=False)]
    context: int
    targets: int
    rounds: int
    figures: dict[str, Figure]
    rows: Annotated[tuple[PublishedRow, ...], Field(strict=False)]
    source: Source
    data_set: DataSet
    stated: Texts
    not_stated: Texts
    notes: Texts


def benchmark_names() -> tuple[str, ...]:
    """The benchmarks there are, as ``load_benchmark`` takes them."""
    return tuple(_specs())


def load_benchmark(name: str) -> Benchmark:
    """A benchmark by its file's name or its printed one, however it is capitalised.

    Raises:
        OptionError: there is no such benchmark.
    """
    specs, key = _specs(), name_key(name)
    if key in specs:
        return parse_benchmark(specs[key])
    raise OptionError(unknown("benchmark", name, specs))


def _specs() -> dict[str, str]:
    """The specifications' texts by their files' names."""
    entries = resources.files("data_specs").joinpath("benchmarks").iterdir()
    texts = {x.name[:-5]: x.read_text(encoding="utf-8") for x in entries if x.name[-5:] == ".yaml"}
    return dict(sorted(texts.items()))


def parse_benchmark(text: str) -> Benchmark:
    """A benchmark from its YAML.

    Raises:
        ValueError: a key that is unknown or absent, or a row without all figures.
    """
    import yaml

    data = yaml.safe_load(text)
    protocol, published = data.pop("protocol"), data.pop("published")
    names = list(data["figures"])
    if published["columns"] != ["system", *names]:
        raise ValueError(f"published.columns: {published['columns']}; expected system, {names}")
    rows = [
        {"system": system, "figures": dict(zip(names, values, strict=True))}
        for system, *values in published["rows"]
    ]
    figures = {name: {"name": name, **figure} for name, figure in data["figures"].items()}
    return Benchmark.model_validate({**data, **protocol, "figures": figures, "rows": rows})


def unknown(what: str, given: object, known: Iterable[str]) -> str:
    """A message that names the nearest of the known names."""
    near = difflib.get_close_matches(str(given), list(known), n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
    return f"{what} {given!r} is unknown; {hint}"


def name_key(text: str) -> str:
    """Letters and digits alone, so that Mip-NeRF 360 is mipnerf360."""
    return "".join(sign for sign in text.casefold() if sign.isalnum())
