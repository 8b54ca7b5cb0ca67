"""``gvtools data list``: which data sets there is a spec of, and what is known of each."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from gvtools.scenes.data_sets.catalogue import DataSetSpec, load_spec, spec_names

if TYPE_CHECKING:
    from pipelines.console import Console

COLUMNS = ("data set", "kind", "scenes", "images", "weight", "roles", "layout")


def list_data_sets(args: argparse.Namespace, console: Console) -> None:
    """Print a table of the data sets, or everything about one."""
    from gvtools.files import write_json

    names = spec_names() if args.name is None else (args.name,)
    specs = [load_spec(name) for name in names]
    if args.json is not None:
        write_json(args.json, {"data_sets": [known_of(spec) for spec in specs]})
        console.line(f"{len(specs)} data sets written to {args.json}")
    elif args.name is None:
        console.table(COLUMNS, table_rows())
        console.line("weight: share in a mixture of all training sets, by the root of their images")
    else:
        console.line(as_yaml(specs[0]).rstrip())
        if share_of(specs[0]) is not None:
            console.line(f"# {share_of(specs[0]):.1%} of a mixture of all training sets")


def all_specs() -> list[DataSetSpec]:
    """Training sets first, then by name."""
    specs = [load_spec(name) for name in spec_names()]
    return sorted(specs, key=lambda spec: ("training" not in spec.roles, spec.name.casefold()))


def share_of(spec: DataSetSpec) -> float | None:
    """Its weight in a mixture of all training sets, of 1; None for other data sets."""
    if "training" not in spec.roles:
        return None
    return spec.weight / sum(x.weight for x in all_specs() if "training" in x.roles)


def table_rows() -> list[tuple[str | None, ...]]:
    """A row a data set, as COLUMNS names them."""
    rows: list[tuple[str | None, ...]] = []
    for spec in all_specs():
        share = share_of(spec)
        rows.append(
            (
                spec.name,
                spec.kind,
                _count(spec.counts.scenes),
                _count(spec.counts.images),
                None if share is None else f"{share:.1%}",
                ", ".join(spec.roles),
                spec.layout,
            )
        )
    return rows


def known_of(spec: DataSetSpec) -> dict[str, Any]:
    """A spec as JSON-ready values, with its weight and its share in a mixture."""
    return {**spec.model_dump(mode="json"), "weight": spec.weight, "share": share_of(spec)}


def as_yaml(spec: DataSetSpec) -> str:
    """What is known of a data set, in the words of its file."""
    import yaml

    known = spec.model_dump(mode="json", exclude_none=True)
    return str(yaml.safe_dump(known, sort_keys=False, allow_unicode=True, width=96))


def _count(number: int | None) -> str | None:
    return None if number is None else f"{number:,}"
