"""Published figures of a benchmark, as ``data_specs/benchmarks`` records them.

A benchmark is a YAML file: its protocol, how each figure is defined, what the source leaves open,
and the rows as published.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from importlib import resources
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from gvtools.errors import OptionError, ProjectError

# What a definition may ask of a setting: its field, and how it is called in a reason.
ASPECTS = {
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
    definition: dict[str, str | None]
    stated: str
    not_stated: Texts
    unit: str = ""

    @field_validator("definition")
    @classmethod
    def _known(cls, definition: dict[str, str | None]) -> dict[str, str | None]:
        for aspect in definition:
            if aspect not in ASPECTS:
                raise ValueError(unknown("aspect", aspect, ASPECTS))
        return definition


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
        ProjectError: its specification is absent, or not what it has to be.
    """
    specs, key = _specs(), name_key(name)
    if key in specs:
        return parse_benchmark(specs[key], f"{key}.yaml")
    raise OptionError(unknown("benchmark", name, specs))


def _specs() -> dict[str, str]:
    """The specifications' texts by their files' names."""
    try:
        entries = list(resources.files("data_specs").joinpath("benchmarks").iterdir())
    except (ImportError, OSError):
        entries = []
    texts = {x.name[:-5]: x.read_text(encoding="utf-8") for x in entries if x.name[-5:] == ".yaml"}
    if not texts:
        raise ProjectError("package data_specs: no benchmarks/*.yaml; install gvtools again")
    return dict(sorted(texts.items()))


def parse_benchmark(text: str, origin: str) -> Benchmark:
    """A benchmark from its YAML; ``origin`` is the file's name, for messages.

    Raises:
        ProjectError: no YAML, a key that is unknown or absent, or a row without all figures.
    """
    import yaml

    try:
        data = dict(yaml.safe_load(text))
        protocol, published = dict(data.pop("protocol")), dict(data.pop("published"))
        figures = {name: {"name": name, **dict(f)} for name, f in dict(data["figures"]).items()}
        data["figures"] = figures
        rows = _rows(published, list(figures))
        return Benchmark.model_validate({**data, **protocol, "rows": rows})
    except yaml.YAMLError as error:
        reason = f"no readable YAML ({' '.join(str(error).split())})"
    except ValidationError as error:
        first = error.errors()[0]
        reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    except KeyError as error:
        reason = f"no {error}"
    except (TypeError, ValueError) as error:
        reason = str(error)
    raise ProjectError(f"{origin}: {reason}; expected a specification like those beside it")


def _rows(published: Mapping[str, Any], figures: list[str]) -> list[dict[str, Any]]:
    columns = ["system", *figures]
    if published["columns"] != columns:
        raise ValueError(f"published.columns: {published['columns']}, not {columns}")
    rows = published["rows"]
    if len({row[0] for row in rows}) < len(rows) or {len(row) for row in rows} != {len(columns)}:
        raise ValueError(f"published.rows: not one a system with {len(figures)} numbers")
    return [{"system": row[0], "figures": dict(zip(figures, row[1:], strict=True))} for row in rows]


def unknown(what: str, given: object, known: Iterable[str]) -> str:
    """A message that names the nearest of the known names."""
    near = difflib.get_close_matches(str(given), list(known), n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
    return f"{what} {given!r} is unknown; {hint}"


def name_key(text: str) -> str:
    """Letters and digits alone, so that Mip-NeRF 360 is mipnerf360."""
    return "".join(sign for sign in text.casefold() if sign.isalnum())
