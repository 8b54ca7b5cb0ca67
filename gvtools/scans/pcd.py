"""Points of PCD files: ASCII, binary, or compressed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.scans.points import Chunk, ScanFile, Station
from gvtools.scans.tables import (
    LEAST_TEXT,
    Columns,
    binary_rows,
    check_size,
    rows_at_once,
    text_rows,
)

MAX_HEADER = 1 << 13
KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS",
        "DATA")  # fmt: skip
KINDS = {"F": "f", "U": "u", "I": "i"}
SIZES = ("1", "2", "4", "8")
# Three compressed bytes stand for no more than 264.
MOST_RATIO = 88
# Of compressed points, which are unpacked into a temporary file.
MOST_BYTES = 1 << 31
# What is read of a compressed file's fields.
READ = ("x", "y", "z", "rgb", "rgba", "intensity")


@dataclass(frozen=True)
class _Header:
    dtype: np.dtype[np.void]
    count: int
    data: str
    offset: int


def open_pcd(path: Path) -> ScanFile:
    """A PCD, its header read."""
    header = _header(path)
    dtype, count = header.dtype, header.count
    width = sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())
    if header.data == "binary_compressed":
        _check_compressed(path, header)
    else:
        text = header.data == "ascii"
        least = LEAST_TEXT * width if text else dtype.itemsize
        check_size(path, header.offset + count * least - text, told=f"{count} points")

    def chunks() -> Iterator[Chunk]:
        if header.data == "binary_compressed":
            rows = _unpacked_rows(path, header)
        elif header.data == "binary":
            rows = binary_rows(path, dtype, count, offset=header.offset)
        else:
            rows = text_rows(path, _flat_names(dtype), count, offset=header.offset)
        for columns in rows:
            yield _chunk(columns, dtype)

    return ScanFile(path, count, (Station(path.stem),), chunks)


def _flat_names(dtype: np.dtype[np.void]) -> tuple[str, ...]:
    """A name for each number of a line: fields of several are numbered."""
    names = []
    for name in dtype.names or ():
        count = int(np.prod(dtype[name].shape))
        names += [name] if count == 1 else [f"{name}[{k}]" for k in range(count)]
    return tuple(names)


def _chunk(columns: Columns, dtype: np.dtype[np.void]) -> Chunk:
    positions = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    packed = next((name for name in ("rgb", "rgba") if name in columns), None)
    colors = None if packed is None else _rgb(columns[packed], dtype[packed])
    intensity = columns["intensity"].astype(np.float32) if "intensity" in columns else None
    return Chunk(positions, colors, intensity)


def _rgb(packed: NDArray[Any], kind: np.dtype[Any]) -> NDArray[np.uint8]:
    """(N, 3) of colours in one number each, 0xRRGGBB; as float, its bits are meant."""
    if kind.kind == "f":
        bits = packed.astype(np.float32).view(np.uint32)
    else:
        bits = packed.astype(np.int64).astype(np.uint32)
    return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def _check_compressed(path: Path, header: _Header) -> None:
    """Refuse sizes that the points or the file contradict, before anything is unpacked."""
    check_size(path, header.offset + 8, told="compressed points")
    packed, whole = np.fromfile(path, "<u4", 2, offset=header.offset).tolist()
    expected = header.count * header.dtype.itemsize
    check_size(path, header.offset + 8 + packed, told=f"{packed} compressed bytes")
    if whole != expected or whole > MOST_RATIO * packed:
        raise MemoryFileError(
            f"{path}: {packed} compressed bytes of {whole}, but its header says {header.count} "
            f"points, that is {expected}; the file is damaged; save it again"
        )
    if whole > MOST_BYTES:
        raise MemoryFileError(
            f"{path}: {whole} bytes when unpacked; expected at most {MOST_BYTES}; save it as "
            "binary PCD or LAZ"
        )


def _unpacked_rows(path: Path, header: _Header) -> Iterator[Columns]:
    """Chunks of compressed points, which lie field by field."""
    from gvtools.scans.lzf import unpack

    dtype, count = header.dtype, header.count
    size = int(np.fromfile(path, "<u4", 1, offset=header.offset)[0])
    packed = np.memmap(path, np.uint8, "r", header.offset + 8, (size,))
    with tempfile.TemporaryFile() as file:
        try:
            found = unpack(packed, file)
        except ValueError:
            found = -1
        del packed
        file.flush()
        if found != count * dtype.itemsize:
            raise MemoryFileError(
                f"{path}: its compressed points unpack to {max(found, 0)} bytes; expected "
                f"{count * dtype.itemsize}; the file is damaged; save it again"
            )
        names = [name for name in READ if name in (dtype.names or ())]
        step = rows_at_once(dtype)
        for first in range(0, count, step):
            rows, columns = min(step, count - first), {}
            for name in names:
                kind, start = dtype.fields[name][:2]  # type: ignore[index]
                file.seek(count * start + first * kind.itemsize)
                columns[name] = np.frombuffer(file.read(rows * kind.itemsize), kind, rows)
            yield columns


def _header(path: Path) -> _Header:
    with path.open("rb") as file:
        head = file.read(MAX_HEADER)
    given: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in given:
        end = head.find(b"\n", offset)
        words = head[offset:end].decode("ascii", "replace").split()
        if end < 0 or (words and not words[0].startswith("#") and words[0] not in KEYS):
            raise MemoryFileError(f"{path}: no PCD header; expected a PCD point cloud")
        offset = end + 1
        if words and not words[0].startswith("#"):
            if words[0] in given:
                raise MemoryFileError(f"{path}: PCD header with two lines {words[0]}")
            given[words[0]] = words[1:]
    try:
        return _checked(given, offset)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise MemoryFileError(
            f"{path}: PCD header that does not describe points x, y, z ({error!r}); expected "
            "FIELDS, SIZE, TYPE, WIDTH, HEIGHT, POINTS and DATA that fit together"
        ) from None


def _checked(given: dict[str, list[str]], offset: int) -> _Header:
    """The header of its lines, by key."""
    names = given["FIELDS"]
    counts = [int(count) for count in given.get("COUNT", ["1"] * len(names))]
    columns: list[tuple[Any, ...]] = []
    for name, kind, size, count in zip(names, given["TYPE"], given["SIZE"], counts, strict=True):
        if not 1 <= count <= 4096 or size not in SIZES:
            raise ValueError(f"COUNT {count}, SIZE {size[:9]}")
        # Gaps between fields have the name _, perhaps several times.
        label = f"gap {len(columns)}" if name == "_" else name
        shape = (label, KINDS[kind] + size)
        columns.append(shape if count == 1 else (*shape, (count,)))
    dtype = np.dtype(columns)
    if not {"x", "y", "z"} <= set(names):
        raise ValueError("no x, y, z")
    several = [name for name in READ if name in names and dtype[name].shape]
    if several:
        raise ValueError(f"{several[0]} of several numbers")
    count = int(given["POINTS"][0])
    if count < 0 or count != int(given["WIDTH"][0]) * int(given["HEIGHT"][0]):
        raise ValueError(f"{count} points")
    data = given["DATA"][0]
    if data not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {data}")
    return _Header(dtype, count, data, offset)
