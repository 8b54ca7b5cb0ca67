"""Documentation of settings from their models: for ``--help-settings`` and as Markdown."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from gvtools.settings.base import Entry, Settings, entries

_TYPES = {bool: "true or false", int: "integer", float: "number", str: "text", Path: "path"}


def listing(*settings: Settings, width: int = 100) -> str:
    """Every setting with its value, range, unit and meaning, by section, for a terminal."""
    lines = []
    for section, about, rows in _all_sections(settings):
        lines += ["", textwrap.fill(f"{section}: {about}" if section else about, width), ""]
        for key, default, accepts, entry in rows:
            unit = f" {entry.unit}" if entry.unit else ""
            lines.append(f"  {key}={default}{unit}  ({accepts})")
            lines += textwrap.wrap(
                entry.doc, width, initial_indent=" " * 6, subsequent_indent=" " * 6
            )
    return "\n".join(lines[1:])


def markdown(*settings: Settings) -> str:
    """The same as Markdown: a heading and a table a section."""
    lines = []
    for section, about, rows in _all_sections(settings):
        lines += [f"## {section or 'General'}", "", about, ""]
        lines += ["| setting | default | unit | accepts | meaning |", "|---|---|---|---|---|"]
        for key, default, accepts, entry in rows:
            meaning = entry.doc.replace("|", "\\|").replace("``", "`")
            lines.append(f"| `{key}` | `{default}` | {entry.unit} | {accepts} | {meaning} |")
        lines.append("")
    return "\n".join(lines)


_Rows = list[tuple[str, str, str, Entry]]


def _all_sections(settings: Sequence[Settings]) -> Iterator[tuple[str, str, _Rows]]:
    """The sections of the first settings, then of others below their own section's name."""
    for i, each in enumerate(settings):
        yield from _sections(each, f"{each.section}." if i and each.section else "")


def _sections(settings: Any, prefix: str = "", doc: str = "") -> Iterator[tuple[str, str, _Rows]]:
    """Each section's key, its class's first line with its own documentation, and its rows."""
    rows: _Rows = []
    inner = []
    for name, entry in entries(type(settings)).items():
        if name in settings.options_of.values():
            continue
        key, value = f"{prefix}{name}", getattr(settings, name, "(required)")
        if entry.section is None:
            rows.append((key, text_of(value), accepts(entry), entry))
        else:
            # What an absent section would hold.
            inner.append((key, entry.section() if value is None else value, entry.doc))
    about = (type(settings).__doc__ or "").strip().split("\n")[0]
    yield prefix.rstrip("."), f"{about} {doc}".strip(), rows
    for key, value, doc in inner:
        yield from _sections(value, f"{key}.", doc)


def text_of(value: Any) -> str:
    """A value as it is given on the command line."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(text_of, value))}]"
    named = {None: "none", True: "true", False: "false"}
    known = value is None or isinstance(value, bool)
    return named[value] if known else f"{value:g}" if isinstance(value, float) else str(value)


def accepts(entry: Entry) -> str:
    """The type or the choices, and the range."""
    kinds = get_args(entry.kind) if entry.optional else (entry.kind,)
    words = [", ".join(get_args(k)) if get_origin(k) is Literal else _named(k)
             for k in kinds if k is not NoneType]  # fmt: skip
    limits = " and ".join(f"{word} {end:g}" for word, end in entry.limits.items())
    text = " or ".join(words) + (f", {limits}" if limits else "")
    return f"{text}, or none" if entry.optional else text


def _named(kind: Any) -> str:
    origin = get_origin(kind)
    if origin in (tuple, list):
        return "list"
    return "options by name" if origin is dict else _TYPES.get(kind, str(kind))
