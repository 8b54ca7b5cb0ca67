"""One parser for all settings: ``key=value`` texts, JSON files (nested or dotted), profiles.

All changes of one call are applied together and checked once, so that settings that depend on each
other may come in any order. Of several values for a key the last one counts. Texts are converted to
the field's type by pydantic; ``none``, ``null`` and ``auto`` are None where a field may be None,
and lists are JSON.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from gvtools.errors import OptionError
from gvtools.settings.base import Entry, Settings, entries, keys, unknown
from gvtools.untrusted import read_json

S = TypeVar("S", bound=Settings)
NONE = ("none", "null", "auto")


def with_texts(settings: S, texts: Iterable[str]) -> S:
    """``settings`` with ``key=value`` texts applied in order."""
    pairs = []
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise OptionError(f"--set {text!r}; expected KEY=VALUE")
        pairs.append((key.strip(), value.strip()))
    return with_values(settings, pairs)


def with_file(settings: S, path: Path, *, presets: Mapping[str, str] | None = None) -> S:
    """``settings`` with those of a JSON file over those of presets.

    Args:
        presets: names of presets by field, in place of those that the file may name.
    """
    try:
        data = read_json(path)
    except (OSError, ValueError) as error:
        raise OptionError(f"{path}: no readable JSON settings ({error})") from None
    if not isinstance(data, dict):
        raise OptionError(f"{path}: holds a {type(data).__name__}; expected an object of settings")
    try:
        return with_values(settings, dotted({**data, **(presets or {})}))
    except OptionError as error:
        raise OptionError(f"{path}: {error}") from None


def with_values(settings: S, values: Iterable[tuple[str, Any]] | Mapping[str, Any]) -> S:
    """``settings`` with the values of dotted keys, texts or plain data."""
    pairs = values.items() if isinstance(values, Mapping) else values
    tree: dict[str, Any] = {}
    for key, value in _expanded(settings, pairs):
        _put(tree, _path(type(settings), key), value, kind=type(settings))
    return type(settings)(**_merged(type(settings), settings, tree))


def dotted(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as dotted keys with their values; an empty object stays one."""
    out: dict[str, Any] = {}
    for key, value in data.items():
        nested = isinstance(value, Mapping) and value
        out |= dotted(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return out


def changes(before: Settings, after: Settings) -> dict[str, Any]:
    """The dotted settings that make ``before`` to ``after``, but for the presets' names."""
    old, new = dotted(before.to_dict()), dotted(after.to_dict())
    prefixes = {f"{field}.": f"{head}." for head, field in after.options_of.items()}
    changed = {}
    for key, value in new.items():
        if key in after.presets or (key in old and old[key] == value):
            continue
        inner = next((prefix for prefix in prefixes if key.startswith(prefix)), None)
        changed[key if inner is None else prefixes[inner] + key.removeprefix(inner)] = value
    return changed


def _expanded(settings: Settings, pairs: Iterable[tuple[str, Any]]) -> Iterator[tuple[str, Any]]:
    """The pairs, those that presets stand for below all others."""
    given = list(pairs)
    for field, presets in settings.presets.items():
        for key, value in given:
            if key != field:
                continue
            if str(value) not in presets:
                known = ", ".join(presets)
                raise OptionError(f"{field} {value!r}; expected one of {known}")
            yield from presets[value].items()
    yield from given


def _path(kind: type[Settings], key: str) -> list[str]:
    head, *rest = key.split(".")
    field = kind.options_of.get(head)
    if field and rest == ["name"]:
        return [head]
    return [field, ".".join(rest)] if field and rest else [head, *rest]


def _put(tree: dict[str, Any], path: list[str], value: Any, *, kind: type[Settings]) -> None:
    """Enter a value into the tree of changes, converted as far as its text needs."""
    inner: type[Settings]
    key, inner, place = ".".join([kind.section, *path] if kind.section else path), kind, tree
    for at, name in enumerate(path):
        entry = entries(inner).get(name)
        if entry is None:
            raise OptionError(unknown(key, keys(kind)))
        if get_origin(entry.kind) is dict and at == len(path) - 2:
            place.setdefault(name, {})[path[-1]] = value
            return
        if at == len(path) - 1:
            place[name] = _converted(key, entry, value)
            return
        if entry.section is None:
            below = f"{'.'.join(path[: at + 1])} is a value without settings below it"
            raise OptionError(f"no setting {key!r}; {below}")
        if not isinstance(place.get(name), dict):
            place[name] = {}
        inner, place = entry.section, place[name]


def _converted(key: str, entry: Entry, value: Any) -> Any:
    if value is None or (isinstance(value, str) and value.lower() in NONE):
        if entry.optional:
            return None
        if get_origin(entry.kind) is dict:
            return {}
    if get_origin(entry.kind) is dict and not isinstance(value, Mapping):
        raise OptionError(f"{key} {value!r}; expected an object of options by name")
    if entry.section is not None and value != {}:
        inside = f"{key}.{next(iter(entries(entry.section)))}"
        raise OptionError(f"{key} {value!r}; it is a section; set one of its own, such as {inside}")
    plain = (entry.kind, *get_args(entry.kind))
    if isinstance(value, bool) and bool not in plain:
        raise OptionError(f"{key} {value}; expected another type than true or false")
    if isinstance(value, str) and any(get_origin(kind) in (tuple, list) for kind in plain):
        try:
            return json.loads(value)
        except ValueError:
            raise OptionError(f"{key} {value!r}; expected a JSON list, such as [1, 2]") from None
    return value


def _merged(kind: type[Settings], current: Any, tree: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of ``current`` with the changes of a tree, sections as dictionaries.

    A section that is absent so far begins with its defaults.
    """
    known = entries(kind)
    values = {} if current is None else {name: getattr(current, name) for name in known}
    for name, change in tree.items():
        section = known[name].section
        if section is not None and change is not None:
            values[name] = _merged(section, values.get(name), change)
        elif get_origin(known[name].kind) is dict and change:
            values[name] = {**values.get(name, {}), **change}
        else:
            values[name] = change
    return values
