"""Ranges of colours and pictures, where the type of their numbers does not tell them.

A range is the least usual one that holds all but a few outliers of the numbers above zero.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Full brightness of whole numbers: of 8, 10, 12, 14 and 16 bits.
WHOLE = (255, 1023, 4095, 16383, 65535)
# Scans may be dark, so that 14 bits are not told from 16; fractions that were cut are 0 or 1.
OF_CLOUDS = (1, 255, 1023, 4095, 65535)
# Colours in hundredths are told by the share that was cut at white: so large, and more than below.
PERCENT, CUT = 100, 0.001
# Fractions of light may go so far beyond 1, where they are cut off.
GLARE = 4.0
# Shares of the numbers above zero that may lie beyond the range.
CLOUD_OUTLIERS, PICTURE_OUTLIERS = 0.02, 0.001
# Numbers beyond the range are said from this share on.
SAID = 0.01
_INTENSITY = re.compile(r"i$|intensit|reflect(ance|ivity)|gr[ae]y|luminance|amplitude")
_AFFIX = re.compile(r"^(scalar|diffuse|vertex|colou?r)_?")


def white_of(values: NDArray[Any], *, tops: Sequence[int], outliers: float) -> float:
    """The number that stands for full brightness; usually one of ``tops``."""
    if values.dtype == np.uint8 and (1 not in tops or values.max(initial=0) > 1):
        return 255
    used = values[np.isfinite(values) & (values > 0)]
    most = float(np.quantile(used, 1 - outliers)) if used.size else tops[-1]
    if values.dtype.kind == "f" and most <= GLARE:
        return 1
    cut = (used == PERCENT).mean() if used.size else 0
    if 1 in tops and most <= PERCENT and cut > max(CUT, ((used >= 99) & (used < PERCENT)).mean()):
        return PERCENT
    usual = (*tops[:-1], 32767) if values.dtype == np.int16 else tops
    return next((top for top in usual if most <= top * (1 + 1e-6)), most)


def to_bytes(values: NDArray[Any], white: float) -> NDArray[np.uint8]:
    """Numbers from 0 to ``white`` as bytes; the upper eight bits of whole ones."""
    if values.dtype == np.uint8 and white == WHOLE[0]:
        return values
    if values.dtype == np.uint16 and white == WHOLE[-1]:
        return (values >> 8).astype(np.uint8)
    known = np.nan_to_num(values.astype(np.float32), posinf=white, neginf=0)
    if values.dtype.kind in "ui" and white in WHOLE:
        return np.clip(known * (256 / (white + 1)), 0, 255).astype(np.uint8)
    return np.rint(np.clip(known * (255 / white), 0, 255)).astype(np.uint8)


def said_of(values: NDArray[Any], white: float) -> str:
    """What was decided, "" where the type says it and all numbers lie within."""
    own = {"u1": 255, "u2": 65535, "f4": 1}.get(values.dtype.str[1:])
    name = "fractions" if values.dtype.kind == "f" else "whole numbers"
    said = [] if white == own else [f"{name} are read as colours from 0 to {white:g}"]
    for beyond, what in ((values < 0, "below 0"), (values > white, f"above {white:g}")):
        if beyond.mean() >= SAID:
            said.append(f"{beyond.mean():.0%} of the colours' numbers are {what}: cut off")
    return ", ".join(said)


def color_names(names: Iterable[str]) -> tuple[str, ...]:
    """The names among ``names`` of red, green and blue, as programs write them; () without all."""
    for channels in (("red", "green", "blue"), ("r", "g", "b")):
        known = {_AFFIX.sub("", name.lower()): name for name in reversed([*names])}
        if set(channels) <= set(known):
            return tuple(known[channel] for channel in channels)
    return ()


def packed_names(names: Iterable[str]) -> tuple[str, ...]:
    """The names of numbers that hold red, green and blue each."""
    return tuple(name for name in names if name.lower() in ("rgb", "rgba"))


def intensity_names(names: Iterable[str]) -> tuple[str, ...]:
    """The names of how much light came back, as programs write them, or of grey."""
    return tuple(name for name in names if _INTENSITY.match(_AFFIX.sub("", name.lower())))
