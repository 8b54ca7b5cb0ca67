"""Plain configuration dataclasses: to JSON and back, strictly, and their ranges."""

from __future__ import annotations

import difflib
import math
import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from gvtools.errors import CheckpointError, OptionError
from gvtools.untrusted import read_json

T = TypeVar("T")


def check_range(
    name: str,  # as the user writes it
    value: float | None,  # the number
    *,
    ge: float | None = None,  # lower end, included
    gt: float | None = None,  # lower end, not included
    le: float | None = None,  # upper end, included
) -> None:
    """Refuse a number outside its range; None, for fields that may be left open, passes."""
    if value is None:
        return
    inside = (
        (ge is None or value >= ge) and (gt is None or value > gt) and (le is None or value <= le)
    )
    if not inside or value != value:
        ends = {"at least": ge, "more than": gt, "at most": le}
        wanted = " and ".join(f"{word} {end:g}" for word, end in ends.items() if end is not None)
        raise OptionError(f"{name} {value}; expected {wanted or 'a number'}")


def to_json(value: Any) -> Any:
    """A configuration as dictionaries, lists, texts, numbers and None."""
    if is_dataclass(value):
        return {entry.name: to_json(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, (tuple, list)):
        return [to_json(entry) for entry in value]
    return value


def from_json(kind: type[T], data: Any, *, where: str = "config") -> T:
    """A configuration of ``kind`` from what ``to_json`` gave; absent keys have their defaults."""
    if not isinstance(data, Mapping):
        raise OptionError(f"{where} = {data!r:.60}; expected an object of fields ({kind.__name__})")
    hints = get_type_hints(kind)
    names = [entry.name for entry in fields(kind)]  # type: ignore[arg-type]
    for key in data:
        if key not in names:
            close = difflib.get_close_matches(str(key), names, n=1, cutoff=0.5)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names)}"
            raise OptionError(f"{where}: no field {key!r}; {hint}")
    return kind(**{key: _value(hints[key], data[key], f"{where}.{key}") for key in data})


def read_model_config(kind: type[T], path: Path, *, field: str | None = None) -> T:
    """A model's configuration, or the one ``field`` of it, from the JSON file in its folder."""
    try:
        stored = read_json(path)
        if field is not None:
            return from_json(kind, stored.get(field, {}), where=field)
        return from_json(kind, stored)
    except FileNotFoundError:
        raise CheckpointError(
            f"no {path}; expected the config.json of a GeoVerse folder (gvtools weights list)"
        ) from None
    except (OSError, ValueError, AttributeError, OptionError) as error:
        raise CheckpointError(f"{path}: {error}; expected a GeoVerse configuration") from None


def _value(kind: Any, data: Any, where: str) -> Any:
    """``data`` as ``kind``; only conversions without loss."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        if data is None and type(None) in arguments:
            return None
        rest = [choice for choice in arguments if choice is not type(None)]
        return _value(rest[0], data, where)
    if origin is Literal:
        if data not in arguments:
            choices = " or ".join(map(repr, arguments))
            raise OptionError(f"{where} = {data!r:.60}; expected {choices}")
        return data
    if origin is tuple:
        if not isinstance(data, (list, tuple)):
            raise OptionError(f"{where} = {data!r:.60}; expected a list")
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_value(arguments[0], entry, where) for entry in data)
        if len(data) != len(arguments):
            raise OptionError(f"{where} = {data!r:.60}; expected {len(arguments)} entries")
        return tuple(_value(k, entry, where) for k, entry in zip(arguments, data, strict=True))
    if is_dataclass(kind):
        return from_json(kind, data, where=where)  # type: ignore[arg-type]
    if kind is float and type(data) is int:
        return float(data)
    if type(data) is not kind:
        raise OptionError(f"{where} = {data!r:.60}; expected {getattr(kind, '__name__', kind)}")
    if kind is float and not math.isfinite(data):
        raise OptionError(f"{where} = {data!r}; expected a finite number")
    return data
