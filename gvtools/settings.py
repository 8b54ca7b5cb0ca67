"""The base of all settings: typed, documented field by field, with ranges that are checked.

A settings class is a pydantic model. The text below a field is its documentation, ``Field(ge=,
gt=, le=, lt=)`` its range. Wrong values end in an OptionError of one line.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

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

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise OptionError(describe(error, type(self))) from None

    # Without this mark pydantic would call __init__ for nested models and lose their path.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def replaced(self: S, **changes: Any) -> S:
        """A copy with some fields changed, checked again.

        Raises:
            OptionError: an unknown field or a value out of range.
        """
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**values, **changes})

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON, nested settings as nested objects."""
        return self.model_dump(mode="json")


def describe(error: ValidationError, kind: type[Settings]) -> str:
    """The first complaint of pydantic as one line: the setting, what was found and expected."""
    first = error.errors()[0]
    path = ".".join(str(part) for part in first["loc"])
    key = f"{kind.section}.{path}" if kind.section else path
    if first["type"] == "extra_forbidden":
        return unknown(key, _keys(kind))
    bounds = [f"{word} {end:g}" for word, end in _bounds(kind, first["loc"]).items()]
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


def _keys(kind: type[Settings]) -> list[str]:
    names = []
    for name, field in kind.model_fields.items():
        key = f"{kind.section}.{name}" if kind.section else name
        inner = field.annotation
        nested = isinstance(inner, type) and issubclass(inner, Settings)
        names += _keys(inner) if nested and isinstance(inner, type) else [key]
    return names


def _bounds(kind: type[Settings], location: tuple[int | str, ...]) -> Mapping[str, float]:
    """The range of the field at a path: its ends in words."""
    for part in location[:-1]:
        field = kind.model_fields.get(str(part))
        if field is None or not isinstance(field.annotation, type):
            return {}
        kind = field.annotation
    field = kind.model_fields.get(str(location[-1]))
    if field is None:
        return {}
    return {
        word: float(getattr(item, end))
        for item in field.metadata
        for end, word in _ENDS.items()
        if getattr(item, end, None) is not None
    }
