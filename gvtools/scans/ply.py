"""Points of PLY files: ASCII or binary of either byte order, with or without faces behind them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.memory.io.ply import TYPES
from gvtools.scans.points import GENERATED, Chunk, ScanFile, Station
from gvtools.scans.tables import LEAST_TEXT, Columns, binary_rows, check_size, text_rows

MAX_HEADER = 1 << 16
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# Names that programs give to the colour, and to how much light came back, the usual first.
COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
INTENSITIES = ("intensity", "scalar_Intensity", "scalar_intensity", "reflectance")


@dataclass(frozen=True)
class _Header:
    """``order`` is numpy's mark of the byte order, "" for text; ``offset`` is the first point's."""

    order: str
    count: int
    columns: tuple[tuple[str, str], ...]
    offset: int


def open_ply(path: Path) -> ScanFile:
    """A PLY, its header read."""
    header = _header(path)
    names = tuple(name for name, _ in header.columns)
    dtype = np.dtype([(name, header.order + kind) for name, kind in header.columns])
    least = dtype.itemsize if header.order else LEAST_TEXT * len(names)
    needed = header.offset + header.count * least - (not header.order)
    check_size(path, needed, told=f"{header.count} points")

    def chunks() -> Iterator[Chunk]:
        if header.order:
            rows = binary_rows(path, dtype, header.count, offset=header.offset)
        else:
            rows = text_rows(path, names, header.count, offset=header.offset)
        for columns in rows:
            yield _chunk(columns, dict(header.columns))

    return ScanFile(path, header.count, (Station(path.stem),), chunks)


def _chunk(columns: Columns, kinds: dict[str, str]) -> Chunk:
    positions = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    colors = next((_colors(columns, n, kinds) for n in COLORS if set(n) <= set(columns)), None)
    intensity = next((columns[n].astype(np.float32) for n in INTENSITIES if n in columns), None)
    chunk = Chunk(positions, colors, intensity)
    return chunk.without(columns[GENERATED] != 0, GENERATED) if GENERATED in columns else chunk


def _colors(columns: Columns, names: tuple[str, ...], kinds: dict[str, str]) -> NDArray[np.uint8]:
    """(N, 3): integers by the range of their type, others from 0 to 1."""
    kind = np.dtype(kinds[names[0]])
    top = float(np.iinfo(kind).max) if kind.kind in "ui" else 1.0
    rgb = np.stack([columns[name].astype(np.float32) for name in names], axis=1)
    return np.rint(np.clip(np.nan_to_num(rgb) * (255 / top), 0, 255)).astype(np.uint8)


def _header(path: Path) -> _Header:
    with path.open("rb") as file:
        head = file.read(MAX_HEADER)
    newline = b"\r\n" if head.startswith(b"ply\r\n") else b"\n"
    mark = newline + b"end_header" + newline
    end = head.find(mark)
    if not head.startswith(b"ply" + newline) or end < 0:
        raise MemoryFileError(f"{path}: no PLY header; expected a PLY point cloud")
    order, count, columns, element = None, -1, list[tuple[str, str]](), ""
    for line in head[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in FORMATS and order is None:
                order = FORMATS[name]
                continue
            case ["element", name, number] if number.isdecimal() and len(number) < 19:
                if name == "vertex" and count < 0:
                    count = int(number)
                elif count < 0 and int(number):
                    break
                element = name
                continue
            case ["property", kind, name] if kind in TYPES:
                if element == "vertex":
                    columns.append((name, TYPES[kind].lstrip("<")))
                continue
            case ["property", "list", *_] if element != "vertex":
                continue
        raise MemoryFileError(
            f"{path}: PLY header line {line[:80]!r}; expected a PLY 1.0 whose vertices come first "
            "and have scalar properties"
        )
    names = [name for name, _ in columns]
    if order is None or count < 0 or not {"x", "y", "z"} <= set(names):
        raise MemoryFileError(f"{path}: PLY header without a format, vertices, or x, y and z")
    if len(set(names)) != len(names):
        raise MemoryFileError(f"{path}: PLY header with two vertex properties of one name")
    return _Header(order, count, tuple(columns), end + len(mark))
