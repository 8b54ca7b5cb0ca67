"""The base of completers' options."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import model_validator

from gvtools.settings import Settings


class CompleterSettings(Settings):
    """Options of a completer, as ``completer.NAME`` in a run's settings."""

    section = "completer"

    @model_validator(mode="before")
    @classmethod
    def _none_in_words(cls, values: Any) -> Any:
        """``none`` and ``null``, as the command line has them, for numbers that may be None."""
        optional = {
            name
            for name, field in cls.model_fields.items()
            if type(None) in get_args(field.annotation) and str not in get_args(field.annotation)
        }
        return {
            name: None if name in optional and str(value).lower() in ("none", "null") else value
            for name, value in values.items()
        }
