"""Figures of an evaluation.json, which lacks the parts that were not measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def nested(data: Mapping[str, Any] | None, *keys: str) -> Any:
    """The value below the keys, one within the other; None where one of them is absent or null."""
    value: Any = data
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value
