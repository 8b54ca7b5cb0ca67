"""Settings: pydantic models with one parser, and their documentation as text and Markdown."""

from __future__ import annotations

from gvtools.settings.base import Settings, changes, dotted, with_file, with_texts, with_values
from gvtools.settings.documentation import listing, markdown

__all__ = [
    "Settings",
    "changes",
    "dotted",
    "listing",
    "markdown",
    "with_file",
    "with_texts",
    "with_values",
]
