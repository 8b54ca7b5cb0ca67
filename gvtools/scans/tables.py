"""Points of PLY and PCD files: rows of numbers, binary or as text, that follow a header."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.glb import drawn_nodes, glb_axes, glb_colors, glb_numbers, read_gltf
from gvtools.kernels import compiled
from gvtools.ply import point_vertices, read_header
from gvtools.ranges import color_names, intensity_names, packed_names
from gvtools.scans.points import CHUNK, GENERATED, Chunk, ScanFile, Station
from gvtools.splat_files import holds_splats, read_splats

# A number and what parts it from the next one; what one takes at most.
LEAST_TEXT, MOST_TEXT = 2, 64
# What a line of text tells.
COLORED = ("x", "y", "z", "red", "green", "blue")
# Bytes of a vertex of a GLB at least.
LEAST_VERTEX = 6
# Of rows that are read at once.
CHUNK_BYTES = 1 << 26
Columns = Mapping[str, NDArray[Any]]

MAX_HEADER = 1 << 13
KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS",
        "DATA")  # fmt: skip
KINDS = {"F": "f", "U": "u", "I": "i"}
SIZES = ("1", "2", "4", "8")
# What compressed points unpack to at most: LZF makes no more than 88 bytes of one, and of points
# about two.
MOST_RATIO, MOST_BYTES = 88, 1 << 31


@dataclass(frozen=True)
class ScanTable:
    """Rows of a file: ``layout`` is "text", "rows" or "columns" (compressed, field by field)."""

    dtype: np.dtype[np.void]
    count: int
    layout: str
    offset: int  # of the first row, bytes
    last: bool = True  # whether nothing comes behind its rows

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each number of a row: fields of several are numbered."""
        names = []
        for name in self.dtype.names or ():
            count = int(np.prod(self.dtype[name].shape))
            names += [name] if count == 1 else [f"{name}[{k}]" for k in range(count)]
        return tuple(names)

    def check(self, path: Path) -> None:
        """Refuse a file that is shorter, or longer, than its header says."""
        text = self.layout == "text"
        least = LEAST_TEXT * len(self.names) if text else self.dtype.itemsize
        needed = self.offset + self.count * least - text
        found = path.stat().st_size
        if found < needed:
            raise MemoryFileError(
                f"{path}: {found} bytes, but its header says {self.count} points, at least "
                f"{needed}; the file is truncated or damaged; save it again"
            )
        if self.layout == "rows" and self.last and found >= needed + max(self.dtype.itemsize, 4):
            raise MemoryFileError(
                f"{path}: {found} bytes, but the {self.count} points that its header says end at "
                f"{needed}: more points, or points as text; mend its header, or save it again"
            )

    def chunks(self, path: Path) -> Iterator[Columns]:
        """Its columns, so many rows at a time that memory does not grow with them."""
        width = 8 * len(self.names) if self.layout == "text" else self.dtype.itemsize
        step = min(CHUNK, max(1, CHUNK_BYTES // width))
        parts = [(first, min(step, self.count - first)) for first in range(0, self.count, step)]
        if self.layout == "columns":
            unpacked = _unpack(path, self)
            for first, rows in parts:
                yield {name: column[first : first + rows] for name, column in unpacked.items()}
        elif self.layout == "rows":
            for first, rows in parts:
                offset = self.offset + first * self.dtype.itemsize
                table = np.fromfile(path, self.dtype, rows, offset=offset)
                yield {name: table[name] for name in self.dtype.names or ()}
        else:
            with path.open("rb") as file:
                file.seek(self.offset)
                for _, rows in parts:
                    yield dict(zip(self.names, _numbers(path, file, self.names, rows), strict=True))
                if self.last and file.read(1 << 16).strip():
                    raise MemoryFileError(
                        f"{path}: more lines than the {self.count} points that its header says; "
                        "mend its header, or save it again"
                    )


def _numbers(path: Path, file: IO[bytes], names: tuple[str, ...], rows: int) -> NDArray[np.float64]:
    """(columns, rows) of the next lines of a text."""
    table, wrong = np.zeros((0, 0)), ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lines = _lines(file, rows, MOST_TEXT * len(names))
            table = np.loadtxt(lines, ndmin=2, comments=None)
    except ValueError as error:
        wrong = f" ({error})"
    if wrong or table.shape != (rows, len(names)):
        raise MemoryFileError(
            f"{path}: expected {rows} lines of {len(names)} numbers with decimal points{wrong}; "
            "the file is truncated or damaged; save it again"
        )
    return table.T


def _lines(file: IO[bytes], count: int, most: int) -> Iterator[bytes]:
    """Lines of a file that are not blank, none of which is longer than ``most`` bytes."""
    while count and (line := file.readline(most)):
        if len(line) == most:
            raise ValueError(f"a line of {most} bytes or more")
        if line.strip():
            count -= 1
            yield line


def open_ply(path: Path) -> ScanFile:
    """A PLY, its header read: of either byte order or as text, with or without faces behind."""
    if holds_splats(path):
        return open_splats(path)
    header = read_header(path)
    vertices = point_vertices(path, header)
    layout = "rows" if header.order else "text"
    last = not any(item.count for item in header.elements if item is not vertices)
    table = ScanTable(header.dtype(vertices), vertices.count, layout, header.offset, last)
    table.check(path)
    kinds = {name: np.dtype(kind) for name, kind in vertices.columns}
    chunks = (_chunk(columns, kinds) for columns in table.chunks(path))
    return ScanFile(path, table.count, (Station(path.stem),), chunks)


def open_text(path: Path) -> ScanFile:
    """Lines of x y z, or of x y z red green blue; normals instead of colours are not taken."""
    most = MOST_TEXT * len(COLORED)
    with path.open("rb") as file:
        while (line := file.readline(most)).startswith((b"#", b"//")):
            pass
        offset = file.tell() - len(line)
        count = bool(line.strip()) + sum(1 for _ in _lines(file, sys.maxsize, most))
    if (width := len(line.split())) not in (3, len(COLORED)):
        raise MemoryFileError(f"{path}: {width} numbers a line; expected x y z (red green blue)")
    kinds = dict.fromkeys(COLORED[:width], np.dtype("f8"))
    table = ScanTable(np.dtype(list(kinds.items())), count, "text", offset)
    chunks = (_chunk(columns, kinds) for columns in table.chunks(path))
    chunks = (replace(c, colors=None) if _normals(c.colors) else c for c in chunks)
    return ScanFile(path, count, (Station(path.stem),), chunks)


def _normals(vectors: NDArray[Any] | None) -> bool:
    """Whether they are all of length 1, or some point backwards, as colours do not."""
    if vectors is None:
        return False
    return bool(vectors.min() < 0 or np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=0.01))


def open_splats(path: Path) -> ScanFile:
    """The centres of Gaussians that are rather opaque, in the colour that they have all around."""
    splats = read_splats(path)
    colors = np.rint(255 * splats.colors).astype(np.uint8)
    chunk = Chunk(splats.positions + splats.origin, colors)
    chunk = chunk.without(~(splats.logits > 0), "transparent Gaussians")
    return ScanFile(path, len(splats), (Station(path.stem),), iter([chunk]))


def open_glb(path: Path) -> ScanFile:
    """Points of a glTF, else its meshes' coloured vertices, or its Gaussians, in its own axes."""
    if holds_splats(path):
        return open_splats(path)
    tree, body = read_gltf(path)
    _, back = glb_axes(tree)
    chunks: dict[bool, list[Chunk]] = {True: [], False: []}
    count = 0
    for node, matrix in drawn_nodes(tree):
        for part in tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            places, of_points = part["attributes"], part.get("mode") == 0
            local = glb_numbers(tree, body, places["POSITION"]).astype(np.float64)
            colors = glb_colors(tree, body, places["COLOR_0"]) if "COLOR_0" in places else None
            count += len(local)
            if count * LEAST_VERTEX > len(body):
                raise ValueError("nodes that draw a mesh several times")
            if of_points or colors is not None:
                world = local @ matrix[:3, :3].T + matrix[:3, 3]
                chunks[of_points].append(Chunk(world @ back.T, colors))
    found = chunks[True] or chunks[False]
    stations = (Station(path.stem),)
    return ScanFile(path, sum(len(chunk.positions) for chunk in found), stations, iter(found))


def _chunk(columns: Columns, kinds: Mapping[str, np.dtype[Any]]) -> Chunk:
    colors = _stored_colors(columns, kinds)
    for name in packed_names(columns)[:1]:
        colors = _unpacked_colors(columns[name], kinds[name])
    intensities = [columns[name].astype(np.float32) for name in intensity_names(columns)]
    positions = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    chunk = Chunk(positions, colors, next(iter(intensities), None))
    return chunk.without(columns[GENERATED] != 0, GENERATED) if GENERATED in columns else chunk


def _stored_colors(columns: Columns, kinds: Mapping[str, np.dtype[Any]]) -> NDArray[Any] | None:
    """(N, 3) colours of separate channels, as they are stored; the whole scan tells their range."""
    names = color_names(columns)
    if not names or any(columns[name].ndim > 1 for name in names):
        return None
    kind = kinds[names[0]]
    rgb = np.stack([columns[name] for name in names], axis=1)
    if kind.kind == "f":
        return rgb.astype(np.float32)
    whole = np.nan_to_num(rgb).astype(np.int64)
    # Unsigned numbers may be declared as signed; of shorts without negative ones the half is white.
    if kind.itemsize > 2 or (kind.str[1:] == "i2" and whole.min(initial=0) >= 0):
        return whole.astype(np.int16) if kind.itemsize == 2 else whole
    return whole.astype(f"u{kind.itemsize}")


def _unpacked_colors(packed: NDArray[Any], kind: np.dtype[Any]) -> NDArray[np.uint8]:
    """(N, 3) of one number a point, 0xRRGGBB; as float, its bits are meant."""
    # In text some programs write the whole number, though they say float; bits are tiny or huge.
    whole = packed.dtype == np.float64 and ((packed == 0) | (packed >= 1)).all()
    if kind.kind == "f" and not (whole and (packed < 1 << 32).all()):
        bits = packed.astype(np.float32).view(np.uint32)
    else:
        bits = packed.astype(np.int64).astype(np.uint32)
    return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def open_pcd(path: Path) -> ScanFile:
    """A PCD, its header read: as text, binary or compressed."""
    table, viewpoint = _pcd_header(path)
    if table.layout == "columns":
        _check_compressed(path, table)
    else:
        table.check(path)
    kinds = {name: table.dtype[name] for name in table.dtype.names or ()}
    chunks = (_chunk(columns, kinds) for columns in table.chunks(path))
    moved = f"VIEWPOINT {' '.join(viewpoint)} is not applied: points are taken as they stand"
    return ScanFile(
        path, table.count, (Station(path.stem),), chunks, notes=(moved,) if viewpoint else ()
    )


def _pcd_header(path: Path) -> tuple[ScanTable, list[str]]:
    """The table of a file, and its viewpoint where that is not the origin's."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER)
    given: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in given:
        end = head.find(b"\n", offset)
        words = head[offset:end].decode("ascii", "replace").split()
        if words[:1] == ["COLUMNS"]:  # of PCD before 0.7
            words[0] = "FIELDS"
        told = bool(words) and not words[0].startswith("#")
        if end < 0 or (told and (words[0] not in KEYS or words[0] in given)):
            raise MemoryFileError(f"{path}: no PCD header; expected each of its lines once")
        offset = end + 1
        if told:
            given[words[0]] = words[1:]
    try:
        viewpoint = given.get("VIEWPOINT", [])
        plain = [float(number) for number in viewpoint] in ([], [0, 0, 0, 1, 0, 0, 0])
        return _pcd_table(given, offset), [] if plain else viewpoint
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise MemoryFileError(
            f"{path}: PCD header that does not describe points x, y, z ({error!r}); expected "
            "FIELDS, SIZE, TYPE, WIDTH, HEIGHT, POINTS and DATA that fit together"
        ) from None


def _pcd_table(given: Mapping[str, list[str]], offset: int) -> ScanTable:
    """The table of a header's lines, by key."""
    names = given["FIELDS"]
    counts = [int(count) for count in given.get("COUNT", ["1"] * len(names))]
    columns: list[tuple[Any, ...]] = []
    for name, kind, size, count in zip(names, given["TYPE"], given["SIZE"], counts, strict=True):
        if count == 0 and name not in _used(names):
            continue
        if not 1 <= count <= 4096 or size not in SIZES:
            raise ValueError(f"COUNT {count}, SIZE {size[:9]}")
        # Gaps between fields have the name _, perhaps several times.
        label = f"gap {len(columns)}" if name == "_" else name
        shape = (label, KINDS[kind.upper()] + size)
        columns.append(shape if count == 1 else (*shape, (count,)))
    dtype = np.dtype(columns)
    wrong = [name for name in _used(names) if name not in names or dtype[name].shape]
    if wrong:
        raise ValueError(f"{wrong[0]} is absent or has several numbers")
    whole = int(given["WIDTH"][0]) * int(given["HEIGHT"][0])
    count = int(given["POINTS"][0]) if "POINTS" in given else whole
    if count < 0 or count != whole:
        raise ValueError(f"{count} points")
    layouts = {"ascii": "text", "binary": "rows", "binary_compressed": "columns"}
    return ScanTable(dtype, count, layouts[given["DATA"][0].lower()], offset)


def _used(names: Iterable[str]) -> tuple[str, ...]:
    """Fields that are read of a file's."""
    found = [*names]
    return ("x", "y", "z", *packed_names(found), *intensity_names(found), *color_names(found))


def _check_compressed(path: Path, table: ScanTable) -> None:
    """Refuse sizes that the points or the file contradict, before anything is unpacked."""
    sizes = np.fromfile(path, "<u4", 2, offset=table.offset).tolist()
    packed, whole = sizes if len(sizes) == 2 else (0, 0)
    expected, there = table.count * table.dtype.itemsize, path.stat().st_size - table.offset - 8
    if packed > max(there, 0) or whole != expected or whole > MOST_RATIO * packed:
        raise MemoryFileError(
            f"{path}: {packed} compressed bytes of {whole}, but its header says {table.count} "
            f"points, that is {expected}; the file is truncated or damaged; save it again"
        )
    if whole > MOST_BYTES:
        raise MemoryFileError(
            f"{path}: {whole} bytes when unpacked; expected at most {MOST_BYTES}; save it as "
            "binary PCD or LAZ"
        )


def _unpack(path: Path, table: ScanTable) -> dict[str, NDArray[Any]]:
    """The columns of compressed points."""
    packed, whole = np.fromfile(path, "<u4", 2, offset=table.offset).tolist()
    data = np.fromfile(path, np.uint8, packed, offset=table.offset + 8)
    out = np.empty(whole, np.uint8)
    if unpack_lzf(data, out) != whole:
        raise MemoryFileError(
            f"{path}: its compressed points do not unpack to {whole} bytes; the file is damaged; "
            "save it again"
        )
    columns = {}
    names = table.dtype.names or ()
    for name in _used(names):
        if name in names:
            kind, start = table.dtype.fields[name][:2]  # type: ignore[index]
            columns[name] = np.frombuffer(out, kind, table.count, offset=table.count * start)
    return columns


@compiled()
def unpack_lzf(packed: Any, out: Any) -> int:
    """Unpack LZF; how many bytes these are, or -1 where it is damaged or ``out`` is too small.

    A control byte below 32 is followed by that many bytes and one more. Any other begins a copy of
    what was unpacked before: its upper three bits are the length less 2 (7: a further byte is
    added), its lower five and the last byte how far back it begins, less 1.
    """
    at, end, count, room = 0, 0, len(packed), len(out)
    while at < count:
        control = int(packed[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > count or end + length > room:
                return -1
            for k in range(length):
                out[end + k] = packed[at + k]
            at += length
        else:
            length = control >> 5
            if length == 7:
                if at >= count:
                    return -1
                length += int(packed[at])
                at += 1
            if at >= count:
                return -1
            source = end - ((control & 31) << 8) - int(packed[at]) - 1
            at += 1
            length += 2
            if source < 0 or end + length > room:
                return -1
            for k in range(length):
                out[end + k] = out[source + k]
        end += length
    return end
