"""The base of all settings: typed, documented field by field, with ranges that are checked.

A settings class is a pydantic model. The text below a field is its documentation, which may end in
its unit ("[px]"), and ``Field(ge=, gt=, le=, lt=)`` its range. Wrong values end in an OptionError
of one line.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from gvtools.errors import OptionError

S = TypeVar("S", bound="Settings")
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
