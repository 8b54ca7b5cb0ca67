"""Published figures of a benchmark, as ``data_specs/benchmarks`` records them.

A benchmark is a YAML file: its protocol, how each figure is defined, what the source leaves open,
and the rows as published.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

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


@dataclass(frozen=True)
class Figure:
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
    better: str
    digits: int
    definition: Mapping[str, str | None]
    stated: str
    not_stated: tuple[str, ...]
    unit: str = ""


@dataclass(frozen=True)
class PublishedRow:
    """What the source reports of one system: every figure, by name."""

    system: str
    figures: Mapping[str, float]


@dataclass(frozen=True)
class Benchmark:
    """A published table with its protocol.

    Attributes:
        name: of the data set, as printed.
        resolution: width and height, pixels.
        context: context views of a round.
        targets: target views of a round.
        rounds: how many rounds.
        figures: by name, in the table's order.
        rows: one a system, in the table's order.
        source: title of the publication, and its table.
        data_set: citation, role, licence, where to get it; in words.
        stated: what the source says of the protocol.
        not_stated: what it leaves open there.
        notes: what does not fit together in the source.
    """

    name: str
    resolution: tuple[int, int]
    context: int
    targets: int
    rounds: int
    figures: Mapping[str, Figure]
    rows: tuple[PublishedRow, ...]
    source: Mapping[str, str]
    data_set: Mapping[str, str]
    stated: tuple[str, ...]
    not_stated: tuple[str, ...]
    notes: tuple[str, ...]


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


_Kinds = dict[str, type]
_SECTIONS = ("data_set", "source", "protocol", "figures", "published")
_SPEC: _Kinds = {"name": str, "notes": list, **dict.fromkeys(_SECTIONS, dict)}
_DATA_SET: _Kinds = dict.fromkeys(("cited_as", "role", "licence", "obtain"), str)
_SOURCE: _Kinds = {"title": str, "table": str}
_PROTOCOL: _Kinds = dict.fromkeys(("context", "targets", "rounds"), int)
_PROTOCOL |= dict.fromkeys(("resolution", "stated", "not_stated"), list)
_FIGURE: _Kinds = dict.fromkeys(("label", "unit", "better", "stated"), str)
_FIGURE |= {"digits": int, "definition": dict, "not_stated": list}
_PUBLISHED: _Kinds = {"columns": list, "rows": list}
_TEXTS = ("stated", "not_stated", "notes")


def parse_benchmark(text: str, origin: str) -> Benchmark:
    """A benchmark from its YAML; ``origin`` is the file's name, for messages.

    Raises:
        ProjectError: no YAML, a key that is unknown or absent, or a row without all figures.
    """
    import yaml

    try:
        spec = _checked(yaml.safe_load(text), _SPEC, origin)
    except yaml.YAMLError as error:
        raise ProjectError(f"{origin}: no readable YAML ({' '.join(str(error).split())})") from None
    protocol = _checked(spec["protocol"], _PROTOCOL, f"{origin}: protocol")
    size = protocol["resolution"]
    if [type(side) for side in size] != [int, int]:
        raise ProjectError(f"{origin}: resolution {list(size)}; expected [width, height] in pixels")
    figures = {n: _figure(n, data, f"{origin}: {n}") for n, data in spec["figures"].items()}
    return Benchmark(
        name=spec["name"],
        **protocol,
        figures=figures,
        rows=_rows(spec["published"], tuple(figures), f"{origin}: published"),
        source=_checked(spec["source"], _SOURCE, f"{origin}: source"),
        data_set=_checked(spec["data_set"], _DATA_SET, f"{origin}: data_set"),
        notes=spec["notes"],
    )


def _figure(name: str, data: Any, where: str) -> Figure:
    entry = _checked({"unit": "", **data} if isinstance(data, dict) else data, _FIGURE, where)
    if entry["better"] not in ("higher", "lower"):
        raise ProjectError(f"{where}: better {entry['better']!r}; expected higher or lower")
    for aspect, value in entry["definition"].items():
        if aspect not in ASPECTS:
            raise ProjectError(unknown(f"{where}: definition", aspect, ASPECTS))
        if not isinstance(value, str | None):
            raise ProjectError(f"{where}: {aspect} {value!r}; expected a text, or null")
    return Figure(name=name, **entry)


def _rows(data: Any, figures: tuple[str, ...], where: str) -> tuple[PublishedRow, ...]:
    table = _checked(data, _PUBLISHED, where)
    columns = ("system", *figures)
    if table["columns"] != columns:
        raise ProjectError(f"{where}: columns {table['columns']}; expected {columns}")
    out: dict[str, PublishedRow] = {}
    for row in table["rows"]:
        types = [type(value) for value in row] if isinstance(row, list) else []
        right = types[:1] == [str] and len(row) == len(columns) and {int, float} >= {*types[1:]}
        if not right or row[0] in out or not all(map(math.isfinite, row[1:])):
            raise ProjectError(f"{where}: row {row}; expected one a system, {len(figures)} numbers")
        out[row[0]] = PublishedRow(row[0], dict(zip(figures, map(float, row[1:]), strict=True)))
    return tuple(out.values())


def _checked(data: Any, kinds: _Kinds, where: str) -> dict[str, Any]:
    """A mapping with exactly these keys, of these types; lists become tuples."""
    expected = f"expected the keys {', '.join(kinds)}"
    if not isinstance(data, dict):
        raise ProjectError(f"{where}: {type(data).__name__}; {expected}")
    for key in data:
        if key not in kinds:
            raise ProjectError(unknown(f"{where}: key", key, kinds))
    for key, kind in kinds.items():
        if key not in data:
            raise ProjectError(f"{where}: no {key!r}; {expected}")
        texts = data[key] if key in _TEXTS and kind is list else ()
        if type(data[key]) is not kind or not all(isinstance(text, str) for text in texts):
            raise ProjectError(f"{where}: {key} {data[key]!r}; expected {kind.__name__}")
    return {key: tuple(value) if kinds[key] is list else value for key, value in data.items()}


def unknown(what: str, given: object, known: Iterable[str]) -> str:
    """A message that names the nearest of the known names."""
    near = difflib.get_close_matches(str(given), list(known), n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
    return f"{what} {given!r} is unknown; {hint}"


def name_key(text: str) -> str:
    """Letters and digits alone, so that Mip-NeRF 360 is mipnerf360."""
    return "".join(sign for sign in text.casefold() if sign.isalnum())
