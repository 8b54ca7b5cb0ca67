"""Completers: fill what the memory does not know of a target view."""

from __future__ import annotations

from gvtools.completers.base import (
    Completer,
    Completion,
    ContextView,
    ScaleAlignment,
    ScaleStatus,
    available,
    create,
    register,
)

__all__ = [
    "Completer",
    "Completion",
    "ContextView",
    "ScaleAlignment",
    "ScaleStatus",
    "available",
    "create",
    "register",
]
