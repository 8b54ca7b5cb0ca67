"""Names of a pass's stages, and a clock that a benchmark may put in."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

HINTS = "hint encoding"
VIDEO = "video features"
LEVEL1 = "level-1 step"
LEVEL0 = "cascade step"
DECODE = "decoding"
STAGES = (HINTS, VIDEO, LEVEL1, LEVEL0, DECODE)

# Within decoding.
BLOCKS = "encoder blocks"
GEOMETRY = "geometry head"
RGB = "RGB head"
DECODING = (BLOCKS, GEOMETRY, RGB)

Clock = Callable[[str], AbstractContextManager[None]]


def no_clock(stage: str) -> AbstractContextManager[None]:
    """Times nothing."""
    return nullcontext()
