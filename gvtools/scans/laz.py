"""What a LAZ says of its compressed pieces, checked before lazrs takes memory for them.

Each piece of points is unpacked at once. Those of LAS 1.4's point formats begin with their first
point, how many there are, and the lengths of their layers: nine of the point itself, and further
ones of colours, infrared, waves and extra bytes.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import IO, Any

from gvtools.errors import MemoryFileError

# The record that describes the compression, and bytes of a record's head.
NAME, NUMBER, RECORD = b"laszip encoded", 22204, 54
# A piece's points beside the file's own size, bytes.
PIECE_BYTES = 1 << 26
# Where the items of a point are listed in the record, and the compressor's kind before them: in
# pieces, or in pieces with layers. Files in one piece, of LASzip's first version, are not read.
ITEMS, PIECES, LAYERED = 32, 2, 3
# Layers of an item by its type; extra bytes have one each.
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
EXTRA = 14


def check_laz(path: Path, *, at: int, point_bytes: int) -> None:
    """Refuse pieces that the file has no room for, or whose points would take too much.

    Args:
        path: a LAZ whose records before the points were checked.
        at: byte at which its points begin.
        point_bytes: of a point that is unpacked.
    """
    import lazrs

    size = path.stat().st_size
    with path.open("rb") as file:
        record = _record(file)
        if record is None:
            raise _damaged(path, "does not say how its points are compressed")
        description = lazrs.LazVlr(record)
        if description.item_size() != point_bytes:
            raise _damaged(path, f"says {description.item_size()} and {point_bytes} bytes a point")
        if not description.uses_variable_size_chunks():
            _check_points(path, description.chunk_size(), point_bytes, size=size)
        layers = _layers(record)
        kind = struct.unpack_from("<H", record)[0]
        if kind != (LAYERED if layers else PIECES):
            raise _damaged(path, f"is compressed in the way {kind}, which is not read")
        file.seek(at)
        table = [(int(points), int(length)) for points, length in _table(file, description)]
        begin = at + 8
        if begin + sum(length for _, length in table) > size:
            raise _damaged(path, "holds less than its table of compressed points says")
        for points, length in table:
            if description.uses_variable_size_chunks():
                _check_points(path, points, point_bytes, size=size)
            if layers:
                file.seek(begin + point_bytes)
                words = file.read(4 * (1 + layers)).ljust(4 * (1 + layers), b"\xff")
                points, *lengths = struct.unpack(f"<{1 + layers}I", words)
                _check_points(path, points, point_bytes, size=size)
                if sum(lengths) > length:
                    raise _damaged(path, f"has {sum(lengths)} bytes in a piece of {length}")
            begin += length


def _table(file: IO[bytes], description: Any) -> list[tuple[int, int]]:
    import lazrs

    found: list[tuple[int, int]] = lazrs.read_chunk_table(file, description)
    return found


def _check_points(path: Path, points: int, point_bytes: int, *, size: int) -> None:
    if points * point_bytes > PIECE_BYTES + size:
        raise _damaged(path, f"says that {points} points are compressed at once")


def _record(file: IO[bytes]) -> bytes | None:
    """The record that describes the compression; None without one."""
    file.seek(0)
    head = file.read(104)
    at, count = struct.unpack_from("<H", head, 94)[0], struct.unpack_from("<I", head, 100)[0]
    for _ in range(count):
        file.seek(at)
        record = file.read(RECORD)
        if len(record) < RECORD:
            return None
        number, length = struct.unpack_from("<HH", record, 18)
        if record[2:18].rstrip(b"\0") == NAME and number == NUMBER:
            return file.read(length)
        at += RECORD + length
    return None


def _layers(record: bytes) -> int:
    """How many layers each piece has; 0 for points of the older formats, which have none."""
    if len(record) < ITEMS + 2:
        return 0
    total = 0
    for k in range(struct.unpack_from("<H", record, ITEMS)[0]):
        if len(record) < ITEMS + 2 + 6 * (k + 1):
            break
        kind, size, _ = struct.unpack_from("<HHH", record, ITEMS + 2 + 6 * k)
        total += size if kind == EXTRA else LAYERS.get(kind, 0)
    return total


def _damaged(path: Path, found: str) -> MemoryFileError:
    return MemoryFileError(f"{path}: {found}; the file is damaged; save it again")
