"""Rows of numbers, binary or as text: what PLY and PCD files hold after their headers."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.scans.points import CHUNK

# A number and what parts it from the next one; what one takes at most.
LEAST_TEXT, MOST_TEXT = 2, 64
# Of rows that are read at once.
CHUNK_BYTES = 1 << 26
Columns = Mapping[str, NDArray[Any]]


def check_size(path: Path, needed: int, *, told: str) -> None:
    """Refuse a file that is shorter than its header says."""
    found = path.stat().st_size
    if found < needed:
        raise MemoryFileError(
            f"{path}: {found} bytes, but its header says {told}, at least {needed}; the file is "
            "truncated or damaged; save it again"
        )


def rows_at_once(dtype: np.dtype[np.void]) -> int:
    """How many rows are read at once."""
    return min(CHUNK, max(1, CHUNK_BYTES // dtype.itemsize))


def binary_rows(
    path: Path, dtype: np.dtype[np.void], count: int, *, offset: int
) -> Iterator[Columns]:
    """Chunks of ``count`` packed rows from a byte on."""
    told = f"{count} points of {dtype.itemsize} bytes"
    check_size(path, offset + count * dtype.itemsize, told=told)
    step = rows_at_once(dtype)
    for first in range(0, count, step):
        rows = min(step, count - first)
        table = np.fromfile(path, dtype, rows, offset=offset + first * dtype.itemsize)
        yield {name: table[name] for name in dtype.names or ()}


def text_rows(path: Path, names: tuple[str, ...], count: int, *, offset: int) -> Iterator[Columns]:
    """Chunks of ``count`` lines of numbers from a byte on, as float64."""
    told = f"{count} lines of {len(names)} numbers"
    check_size(path, offset + LEAST_TEXT * count * len(names) - 1, told=told)
    with path.open("rb") as file:
        file.seek(offset)
        step = min(CHUNK, max(1, CHUNK_BYTES // (8 * len(names))))
        for first in range(0, count, step):
            rows = min(step, count - first)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    table = np.loadtxt(
                        _lines(file, rows, MOST_TEXT * len(names)), ndmin=2, comments=None
                    )
            except ValueError as error:
                raise MemoryFileError(
                    f"{path}: a point is not {len(names)} numbers ({error}); save it again"
                ) from None
            if table.shape != (rows, len(names)):
                raise MemoryFileError(
                    f"{path}: {table.shape} numbers; expected {told}; the file is truncated or "
                    "damaged; save it again"
                )
            yield dict(zip(names, table.T, strict=True))


def _lines(file: IO[bytes], count: int, most: int) -> Iterator[bytes]:
    """Lines of a file, none of which is longer than ``most`` bytes."""
    for _ in range(count):
        line = file.readline(most)
        if len(line) == most:
            raise ValueError(f"a line of {most} bytes or more")
        if not line:
            return
        yield line
