"""Arrays in one file that are mapped into memory, each with a checksum.

A file holds a line that names its kind, the length and CRC-32 of a JSON header, the header, and the
arrays, each at a multiple of 64 bytes. Reading a column of some segments touches their pages alone.
"""

from __future__ import annotations

import json
import math
import re
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.files import replaced_when_written
from gvtools.untrusted import regular

MAGIC = b"gvtools arrays 1"
ALIGNED = 64
KINDS = re.compile("[<>|][biuf][1248]")
_HEAD = struct.Struct("<II")


def write_arrays(
    path: Path, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], *, flush: bool = True
) -> None:
    """Write ``arrays`` and JSON-ready ``meta``; an older file stays until the new one is whole."""
    table, at = {}, 0
    for name, array in arrays.items():
        table[name] = [array.dtype.str, list(array.shape), at, _crc(array)]
        at += -(-array.nbytes // ALIGNED) * ALIGNED
    header = json.dumps({"meta": meta, "arrays": table}).encode()
    with replaced_when_written(path, flush=flush) as temporary, temporary.open("wb") as file:
        file.write(MAGIC + _HEAD.pack(len(header), zlib.crc32(header)) + header)
        for array in arrays.values():
            file.write(bytes(-file.tell() % ALIGNED))
            file.write(_bytes(array).data)
        file.write(bytes(-file.tell() % ALIGNED))


class ArrayFile:
    """A file of arrays, read; an array's checksum is compared when it is first asked for.

    The arrays are mapped copy-on-write: kernels take them as any other, and the file stays.
    ``meta`` was written beside them; ``checksum`` is the header's CRC-32.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        start = len(MAGIC) + _HEAD.size
        try:
            with regular(path).open("rb") as file:
                head = file.read(start)
                if head[: len(MAGIC)] != MAGIC or len(head) < start:
                    raise MemoryFileError(f"{path}: not a file of arrays of gvtools")
                length, self.checksum = _HEAD.unpack(head[len(MAGIC) :])
                size = path.stat().st_size
                header = file.read(min(length, size))
        except OSError as error:
            raise MemoryFileError(f"{path}: cannot be read ({error.strerror})") from None
        if len(header) != length or zlib.crc32(header) != self.checksum:
            raise self._damaged("its header")
        try:
            parsed = json.loads(header)
            self.meta: dict[str, Any] = dict(parsed["meta"])
            self._table: dict[str, list[Any]] = dict(parsed["arrays"])
            for kind, shape, at, _ in self._table.values():
                # Before NumPy sees it, which takes such texts for Python.
                known = isinstance(kind, str) and KINDS.fullmatch(kind) and at % ALIGNED == 0
                if not known or any(type(n) is not int or not 0 <= n < 2**48 for n in (at, *shape)):
                    raise ValueError(f"array of type {kind!r}, shape {shape!r} at {at!r}")
        except (KeyError, RecursionError, TypeError, ValueError) as error:
            raise MemoryFileError(f"{path}: a header that none of gvtools is ({error})") from None
        self._data = -(-(start + length) // ALIGNED) * ALIGNED
        ends = [at + _nbytes(kind, shape) for kind, shape, at, _ in self._table.values()]
        if size != self._data + -(-max(ends, default=0) // ALIGNED) * ALIGNED:
            raise MemoryFileError(
                f"{path}: {size} bytes, which is not what its header lists; the file is truncated "
                "or damaged; restore it or run again"
            )
        self._map = np.asarray(np.memmap(path, np.uint8, "c"))
        self._checked: set[str] = set()

    @property
    def names(self) -> tuple[str, ...]:
        """The arrays."""
        return tuple(self._table)

    def array(self, name: str) -> NDArray[Any]:
        """An array in the file's own pages."""
        if name not in self._table:
            raise MemoryFileError(f"{self.path}: holds no array {name}; run again")
        kind, shape, at, crc = self._table[name]
        first = self._data + at
        array = self._map[first : first + _nbytes(kind, shape)].view(kind).reshape(shape)
        if name not in self._checked:
            if _crc(array) != crc:
                raise self._damaged(f"its array {name}")
            self._checked.add(name)
        return array

    def _damaged(self, what: str) -> MemoryFileError:
        return MemoryFileError(
            f"{self.path}: {what} does not match its checksum; the file is damaged; restore it or "
            "run again"
        )


def _nbytes(kind: str, shape: list[int]) -> int:
    return math.prod((np.dtype(kind).itemsize, *shape))


def _bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def _crc(array: NDArray[Any]) -> int:
    return zlib.crc32(_bytes(array).data)
