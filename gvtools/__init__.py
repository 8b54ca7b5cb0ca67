"""gvtools: posed photographs or RGB-D in, a coloured point-cloud memory that grows, numbers out."""

from __future__ import annotations

__version__ = "0.1.0"
