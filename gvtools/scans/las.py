"""Points of LAS and LAZ files, through laspy."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvtools.errors import MemoryFileError
from gvtools.scans.points import CHUNK, GENERATED, Chunk, ScanFile, Station

if TYPE_CHECKING:
    import laspy

# Classes of points that are no surface: noise, low and high.
NOISE = (7, 18)
COLORS = ("red", "green", "blue")
# Bits that a compressed point takes at least; LASzip spends far more on coordinates.
LEAST_BITS = 1
# Of points that are read at once.
CHUNK_BYTES = 1 << 26
# Bytes of a header up to the counts of its records, and what each record takes at least.
LEAST_HEADER, RECORD, LONG_RECORD = 227, 54, 60


def open_las(path: Path, *, generated: bool = False) -> ScanFile:
    """A LAS or LAZ, its header read.

    Args:
        path: the file.
        generated: whether points are kept that a completer made.
    """
    import laspy

    _check_records(path)
    with laspy.open(path) as reader:
        header = reader.header
        count, compressed = int(header.point_count), header.are_points_compressed
        room = path.stat().st_size - int(header.offset_to_point_data)
        size = int(header.point_format.size)
    if count * (LEAST_BITS if compressed else 8 * size) > 8 * max(room, 0):
        raise MemoryFileError(
            f"{path}: {room} bytes of points, but its header says {count} points of {size} bytes; "
            "the file is truncated or damaged; save it again"
        )

    def chunks() -> Iterator[Chunk]:
        with laspy.open(path) as reader:
            for points in reader.chunk_iterator(min(CHUNK, max(1, CHUNK_BYTES // max(size, 1)))):
                yield _chunk(points, generated=generated)

    return ScanFile(path, count, (Station(path.stem),), chunks)


def _check_records(path: Path) -> None:
    """Refuse more records before and after the points than the file has room for."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if not head.startswith(b"LASF") or len(head) < LEAST_HEADER:
        raise MemoryFileError(f"{path}: no LAS header; expected a LAS or LAZ point cloud")
    header_size, at, records = struct.unpack_from("<HII", head, 94)
    room = min(at, size) - header_size
    if at > size or records * RECORD > max(room, 0):
        raise MemoryFileError(
            f"{path}: its header says {records} records before byte {at} of {size}; the file is "
            "truncated or damaged; save it again"
        )
    if head[25] >= 4 and len(head) >= 247:
        start, long_records = struct.unpack_from("<QI", head, 235)
        if long_records and not _long_records_fit(path, start, long_records, size=size):
            raise MemoryFileError(
                f"{path}: its header says {long_records} records after byte {start} of {size}; the "
                "file is truncated or damaged; save it again"
            )
    if head[104] & 0x80:
        from gvtools.scans.laz import check_laz

        _check_pieces(path, at, size)
        check_laz(path, at=at, point_bytes=struct.unpack_from("<H", head, 105)[0])


def _long_records_fit(path: Path, at: int, count: int, *, size: int) -> bool:
    """Whether the records after the points, whose heads tell their lengths, end in the file."""
    if at + count * LONG_RECORD > size:
        return False
    with path.open("rb") as file:
        for _ in range(count):
            file.seek(at)
            head = file.read(LONG_RECORD)
            if len(head) < LONG_RECORD:
                return False
            # After two reserved bytes, a name of 16 and a number of two.
            at += LONG_RECORD + int(struct.unpack_from("<Q", head, 20)[0])
            if at > size:
                return False
    return True


def _check_pieces(path: Path, at: int, size: int) -> None:
    """Refuse a table of compressed pieces that is larger than the file."""
    with path.open("rb") as file:
        file.seek(at)
        word = file.read(8)
        table = struct.unpack("<q", word)[0] if len(word) == 8 else size
        if table == -1:
            # Written without seeking: the last eight bytes tell.
            file.seek(max(size - 8, 0))
            table = struct.unpack("<q", file.read(8))[0]
        pieces = size
        if at <= table <= size - 8:
            file.seek(table)
            pieces = struct.unpack("<II", file.read(8))[1]
    if pieces > max(size - at, 0):
        raise MemoryFileError(
            f"{path}: no table of its compressed points; the file is truncated or damaged; save it "
            "again"
        )


def _chunk(points: laspy.ScaleAwarePointRecord, *, generated: bool) -> Chunk:
    names = set(points.point_format.dimension_names)
    positions = np.stack([np.asarray(points[axis], np.float64) for axis in "xyz"], axis=1)
    colors = None
    if set(COLORS) <= names:
        colors = np.stack([np.asarray(points[name], np.uint16) for name in COLORS], axis=1)
    chunk = Chunk(positions, colors, np.asarray(points["intensity"], np.float32))
    bad = np.asarray(points["withheld"]) != 0
    bad |= np.isin(np.asarray(points["classification"]), NOISE)
    if GENERATED in names and not generated:
        made = np.asarray(points[GENERATED]) != 0
        chunk, bad = chunk.without(made, GENERATED), bad[~made]
    return chunk.without(bad, "withheld or noise")
