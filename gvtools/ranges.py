"""Ranges of colours and pictures, where the type of their numbers does not tell them.

A range is the least usual one that holds all but a few outliers of the numbers above zero.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Full brightness of whole numbers: of 8, 10, 12, 14 and 16 bits; and of fractions.
WHOLE, FRACTIONS = (255, 1023, 4095, 16383, 65535), (1.0, 255.0, 65535.0)
# Scans may be dark, so that 14 bits are not told from 16.
OF_CLOUDS = (255, 1023, 4095, 65535)
# Shares of the numbers above zero that may lie beyond the range.
CLOUD_OUTLIERS, PICTURE_OUTLIERS = 0.02, 0.001
_AFFIX = re.compile(r"^(scalar|diffuse|vertex|colou?r)_?")


def white_of(values: NDArray[Any], *, tops: Sequence[int], outliers: float) -> float:
    """The number that stands for full brightness; whole numbers have one of ``tops``."""
    if values.dtype == np.uint8:
        return 255
    used = values[np.isfinite(values) & (values > 0)]
    usual = tops if values.dtype.kind in "ui" else FRACTIONS
    most = float(np.quantile(used, 1 - outliers)) if used.size else usual[-1]
    return next((top for top in usual if most <= top * (1 + 1e-6)), most)


def to_bytes(values: NDArray[Any], white: float) -> NDArray[np.uint8]:
    """Numbers from 0 to ``white`` as bytes; the upper eight bits of whole ones."""
    if values.dtype == np.uint8:
        return values
    if values.dtype == np.uint16 and white == WHOLE[-1]:
        return (values >> 8).astype(np.uint8)
    known = np.nan_to_num(values.astype(np.float32), posinf=white, neginf=0)
    if values.dtype.kind in "ui" and white in WHOLE:
        return np.clip(known * (256 / (white + 1)), 0, 255).astype(np.uint8)
    return np.rint(np.clip(known * (255 / white), 0, 255)).astype(np.uint8)


def said_of(kind: np.dtype[Any], white: float) -> str:
    """What was decided, "" where the type says it."""
    own = {"u1": 255, "u2": 65535, "f4": 1}.get(kind.str[1:])
    return "" if white == own else f"{kind.name} numbers are read as colours from 0 to {white:g}"


def color_names(names: Iterable[str]) -> tuple[str, ...]:
    """The names among ``names`` of red, green and blue, as programs write them; () without all."""
    for channels in (("red", "green", "blue"), ("r", "g", "b")):
        known = {_AFFIX.sub("", name.lower()): name for name in reversed([*names])}
        if set(channels) <= set(known):
            return tuple(known[channel] for channel in channels)
    return ()
