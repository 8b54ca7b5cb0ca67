"""Completers: fill what the memory does not know of a target view."""

from __future__ import annotations

from gvtools.completers.base import (
    Completer,
    Completion,
    ContextView,
    available,
    create,
    register,
)
from gvtools.completers.scale_alignment import ScaleAlignment, ScaleStatus

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
