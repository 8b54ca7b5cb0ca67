"""Rows of numbers, binary or as text: what PLY and PCD files hold after their headers."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.scans.points import CHUNK

# A number and what parts it from the next one.
LEAST_TEXT = 2
Columns = Mapping[str, NDArray[Any]]


def check_size(path: Path, needed: int, *, told: str) -> None:
    """Refuse a file that is shorter than its header says.

    Raises:
        MemoryFileError: see above.
    """
    found = path.stat().st_size
    if found < needed:
        raise MemoryFileError(
            f"{path}: {found} bytes, but its header says {told}, at least {needed}; the file is "
            "truncated or damaged; save it again"
        )


def binary_rows(
    path: Path, dtype: np.dtype[np.void], count: int, *, offset: int
) -> Iterator[Columns]:
    """Chunks of ``count`` packed rows from a byte on.

    Raises:
        MemoryFileError: the file is too short.
    """
    told = f"{count} points of {dtype.itemsize} bytes"
    check_size(path, offset + count * dtype.itemsize, told=told)
    for first in range(0, count, CHUNK):
        rows = min(CHUNK, count - first)
        table = np.fromfile(path, dtype, rows, offset=offset + first * dtype.itemsize)
        yield {name: table[name] for name in dtype.names or ()}


def text_rows(path: Path, names: tuple[str, ...], count: int, *, offset: int) -> Iterator[Columns]:
    """Chunks of ``count`` lines of numbers from a byte on, as float64.

    Raises:
        MemoryFileError: too few lines, or one that holds anything else.
    """
    told = f"{count} lines of {len(names)} numbers"
    check_size(path, offset + LEAST_TEXT * count * len(names) - 1, told=told)
    with path.open("rb") as file:
        file.seek(offset)
        for first in range(0, count, CHUNK):
            rows = min(CHUNK, count - first)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    table = np.loadtxt(islice(file, rows), ndmin=2, comments=None)
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
