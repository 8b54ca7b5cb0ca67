"""Command-line options generated from the fields of settings."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from gvtools.settings import Settings
from gvtools.settings.base import Entry, entries
from gvtools.settings.documentation import accepts, shown


def add_settings(
    parser: argparse._ActionsContainer,
    settings: Settings,
    options: Mapping[str, str],
    *,
    metavars: Mapping[str, str] | None = None,
) -> None:
    """An option for each of some settings; one that is not given is None.

    Type, choices, range, unit and help are the field's, the default is that of ``settings``. An
    optional boolean, or one that is true, gets ``--no-NAME`` as well.

    >>> from pydantic import Field
    >>> class Blur(Settings):
    ...     radius: float = Field(1.0, ge=0, description="Of the kernel. [px]")
    >>> parser = argparse.ArgumentParser()
    >>> add_settings(parser, Blur(), {"blur_radius": "radius"})
    >>> print(parser.format_help().splitlines()[-1].strip())
    --blur-radius PX  Of the kernel (number, at least 0; default 1 px)
    >>> given_settings(parser.parse_args(["--blur-radius", "2"]), {"blur_radius": "radius"})
    {'radius': 2.0}

    Args:
        options: dotted settings by the options' names in ``args``.
        metavars: of options, where the unit or the type does not say enough.
    """
    for name, key in options.items():
        holder: Any = settings
        *sections, field = key.split(".")
        for section in sections:
            holder = getattr(holder, section)
        entry = entries(type(holder))[field]
        metavar = (metavars or {}).get(name)
        parser.add_argument(
            f"--{name.replace('_', '-')}", dest=name, default=None,
            **_form(entry, getattr(holder, field), metavar=metavar),
        )  # fmt: skip


def given_settings(args: argparse.Namespace, options: Mapping[str, str]) -> dict[str, Any]:
    """Values by setting, of those options of ``add_settings`` that were given."""
    values = {key: getattr(args, name) for name, key in options.items()}
    return {key: value for key, value in values.items() if value is not None}


def _form(entry: Entry, value: Any, *, metavar: str | None) -> dict[str, Any]:
    """Arguments of ``add_argument`` for a field beside its name."""
    kinds = [kind for kind in get_args(entry.kind) or (entry.kind,) if kind is not NoneType]
    if get_origin(entry.kind) is Literal:
        kinds = [entry.kind]
    kind, plain = kinds[0], len(kinds) == 1
    notes = [accepts(entry).removesuffix(", or none")] if kind in (int, float) else []
    form: dict[str, Any] = {}
    if kind is bool:
        one_way = value is False and not entry.optional
        form["action"] = "store_true" if one_way else argparse.BooleanOptionalAction
    elif get_origin(kind) is Literal:
        form["choices"] = get_args(kind)
    else:
        names = {int: "N", float: "X", Path: "PATH"}
        # A setting that may be none takes that word, too: the settings read it.
        form["type"] = kind if plain and kind in names and not entry.optional else str
        form["metavar"] = metavar or entry.unit.upper() or names.get(kind)
    if value is not None and kind is not bool:
        notes.append(f"default {shown(value)} {entry.unit}".rstrip())
    about = f" ({'; '.join(notes)})" if notes else ""
    return {**form, "help": f"{entry.doc.removesuffix('.')}{about}".replace("%", "%%")}
