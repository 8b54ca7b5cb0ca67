"""The base of all settings: typed, documented field by field, with ranges that are checked.

A settings class is a pydantic model. The text below a field is its documentation, which may end in
its unit ("[px]"), and ``Field(ge=, gt=, le=, lt=)`` its range. Wrong values end in an OptionError
of one line.

One parser takes ``key=value`` texts, JSON files (nested or dotted) and profiles. All changes of one
call are applied together and checked once, so that settings that depend on each other may come in
any order. Of several values for a key the last one counts. Texts are converted to the field's type
by pydantic; ``none``, ``null`` and ``auto`` are None where a field may be None, and lists are JSON.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError

from gvtools.errors import OptionError
from gvtools.untrusted import read_json

S = TypeVar("S", bound="Settings")
NONE = ("none", "null", "auto")
_ENDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}


class Settings(BaseModel):
    """Frozen settings; a key that is not a field is refused.

    >>> from pydantic import Field
    >>> class Blur(Settings):
    ...     section = "blur"
    ...     radius: float = Field(1.0, ge=0)
    >>> Blur(radius=2).radius
    2.0
    >>> Blur(radius=-1)
    Traceback (most recent call last):
        ...
    gvtools.errors.OptionError: blur.radius -1; expected at least 0
    >>> Blur(radus=2)
    Traceback (most recent call last):
        ...
    gvtools.errors.OptionError: no setting 'blur.radus'; did you mean 'blur.radius'?
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False
    )

    # What the settings are called on the command line, before the dot; "" at the top.
    section: ClassVar[str] = ""
    # Fields whose value stands for several other settings, such as ``profile``: what each of their
    # values changes, as dotted keys.
    presets: ClassVar[Mapping[str, Mapping[str, Mapping[str, Any]]]] = {}
    # Plain fields that take options below them, and the mapping field that keeps those unchecked;
    # ``.name`` below such a field is the field itself.
    options_of: ClassVar[Mapping[str, str]] = {}

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise OptionError(describe(error, type(self))) from None

    # Without this mark pydantic would call __init__ for nested models and lose their path.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @classmethod
    def key(cls, path: str) -> str:
        """What messages call the field at a dotted path."""
        return f"{cls.section}.{path}" if cls.section else path

    def replaced(self: S, **changes: Any) -> S:
        """A copy with some fields changed, checked again."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**values, **changes})

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON, nested settings as nested objects."""
        return self.model_dump(mode="json")


@dataclass(frozen=True)
class Entry:
    """One field of a section."""

    kind: Any  # its type
    limits: Mapping[str, float]  # its range, from end in words to number
    doc: str  # its documentation without the unit
    unit: str = ""  # "" where it has none, or where the documentation says it in words

    @property
    def section(self) -> type[Settings] | None:
        """The class of a nested section, which may be optional; None for a plain field."""
        choices = (kind for kind in (self.kind, *get_args(self.kind)) if isinstance(kind, type))
        return next((kind for kind in choices if issubclass(kind, Settings)), None)

    @property
    def optional(self) -> bool:
        """Whether None is a value."""
        return type(None) in get_args(self.kind)


def entries(kind: type[Settings]) -> dict[str, Entry]:
    """The fields of a class of settings, by name."""
    return {
        name: _entry(field.annotation, field.metadata, field.description or "")
        for name, field in kind.model_fields.items()
    }


def _entry(kind: Any, metadata: Sequence[Any], doc: str) -> Entry:
    limits = {
        word: float(getattr(item, end))
        for item in metadata
        for end, word in _ENDS.items()
        if getattr(item, end, None) is not None
    }
    text = " ".join(doc.split())
    unit = re.search(r" \[([^\]]*)\]$", text)
    return Entry(kind, limits, text[: unit.start()], unit[1]) if unit else Entry(kind, limits, text)


def describe(error: ValidationError, kind: type[Settings]) -> str:
    """The first complaint of pydantic as one line: the setting, what was found and expected."""
    first = error.errors()[0]
    path = ".".join(part for part in first["loc"] if isinstance(part, str))
    key = kind.key(path)
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return unknown(key, keys(kind))
    entry = _entry_at(kind, path.split("."))
    bounds = [f"{word} {end:g}" for word, end in entry.limits.items()] if entry else []
    numeric = first["type"] in ("finite_number", *(f"{end}_than" for end in ("less", "greater")))
    if bounds and (numeric or first["type"].endswith("_than_equal")):
        return f"{key} {first['input']}; expected {' and '.join(bounds)}"
    message = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    return f"{key} {first['input']!r}; expected {message}"


def unknown(key: str, known: list[str]) -> str:
    """What to say of a key that is no setting: the nearest one, or all."""
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
    return f"no setting {key!r}; {hint}"


def keys(kind: type[Settings], prefix: str | None = None) -> list[str]:
    """Every dotted key of a class of settings."""
    if prefix is None:
        prefix = f"{kind.section}." if kind.section else ""
    names = []
    for name, entry in entries(kind).items():
        if name in kind.options_of.values():
            continue
        nested = entry.section
        names += keys(nested, f"{prefix}{name}.") if nested else [f"{prefix}{name}"]
    return names


def _entry_at(kind: type[Settings], path: Sequence[str]) -> Entry | None:
    """The field at a path; None where there is none."""
    entry = entries(kind).get(path[0])
    if entry is None or len(path) == 1:
        return entry
    return _entry_at(entry.section, path[1:]) if entry.section else None


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
        if not isinstance(data, dict):
            raise OptionError(f"holds a {type(data).__name__}; expected an object of settings")
        return with_values(settings, dotted({**data, **(presets or {})}))
    except OptionError as error:
        raise OptionError(f"{path}: {error}") from None
    except (OSError, ValueError) as error:
        raise OptionError(f"{path}: no readable JSON settings ({error})") from None


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
