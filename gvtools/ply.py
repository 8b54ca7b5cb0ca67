"""PLY files: the header and the vertices of any, and binary ones, written and read strictly.

Open3D's own PLY reader returns the header's number of points for a truncated file, the missing
ones being whatever the heap held. Here counts have to fit the file's size.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.files import replaced_when_written
from gvtools.untrusted import regular

# NumPy's mark of the byte order of each format; text has none.
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
MAX_HEADER = 1 << 16
# A number as text and what parts it from the next one, at least.
LEAST_TEXT = 2
TRIANGLE = np.dtype([("count", "u1"), ("rows", "<i4", 3)])


@dataclass
class Element:
    """Vertices, faces or others; ``lists`` tells whether a property is a list of any length."""

    name: str
    count: int
    columns: list[tuple[str, str]] = field(default_factory=list)  # name and NumPy's kind
    lists: bool = False


@dataclass(frozen=True)
class Header:
    """``order`` is NumPy's mark of the byte order, "" for text; ``offset`` the first value's."""

    order: str
    elements: tuple[Element, ...]
    offset: int
    comments: tuple[str, ...] = ()

    def holds(self, name: str) -> bool:
        """Whether there are elements of a name."""
        return any(element.name == name and element.count for element in self.elements)

    @property
    def vertices(self) -> Element | None:
        """The first element, where it is of vertices with scalar properties; others are empty."""
        first = next((item for item in self.elements if item.count or item.name == "vertex"), None)
        return None if first is None or first.name != "vertex" or first.lists else first

    def dtype(self, element: Element) -> np.dtype[np.void]:
        """A row of an element."""
        return np.dtype([(name, self.order + kind) for name, kind in element.columns])


def read_header(path: Path) -> Header:
    """The header of a PLY 1.0, whose elements the file has room for."""
    try:
        with regular(path).open("rb") as file:
            head = file.read(MAX_HEADER)
    except OSError as error:
        raise MemoryFileError(f"{path}: cannot be read ({error.strerror})") from None
    # Programs leave blanks at the ends of lines, and a mark of Unicode in front.
    begin = re.match(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r?\n)", head)
    mark = begin and re.search(rb"\r?\nend_header[ \t]*" + begin[1], head)
    if not begin or not mark:
        raise MemoryFileError(f"{path}: no PLY header; expected a PLY file")
    order, elements, size = None, list[Element](), path.stat().st_size
    comments: list[str] = []
    for line in head[: mark.start()].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case []:
                continue
            case ["comment" | "obj_info", *words]:
                comments.append(" ".join(words))
                continue
            case ["format", name, "1.0"] if name in ORDERS and order is None:
                order = ORDERS[name]
                continue
            case ["element", name, number] if number.isdecimal() and len(number) < 19:
                if int(number) > size:
                    raise MemoryFileError(
                        f"{path}: {size} bytes, but its header says {number} points or others of "
                        f"{name!r}; the file is truncated or damaged; save it again"
                    )
                elements.append(Element(name, int(number)))
                continue
            case ["property", kind, name] if kind in TYPES and elements:
                elements[-1].columns.append((name, TYPES[kind]))
                continue
            case ["property", "list", count, kind, _] if {count, kind} <= {*TYPES} and elements:
                elements[-1].lists = True
                continue
        raise MemoryFileError(
            f"{path}: PLY header line {line[:80]!r}; expected PLY 1.0 with a format, and elements "
            "with their properties"
        )
    if order is None:
        raise MemoryFileError(f"{path}: PLY header without a format")
    for item in elements:
        names = [name.lower() for name, _ in item.columns]
        # PDAL and MDAL write X, Y, Z.
        if not {"x", "y", "z"} <= {name for name, _ in item.columns} and len({*names}) == len(
            names
        ):
            item.columns[:] = [(name.lower(), kind) for name, kind in item.columns]
    return Header(order, tuple(elements), mark.end(), tuple(comments))


def point_vertices(path: Path, header: Header) -> Element:
    """The vertices of a header, refused where they are no points."""
    vertices = header.vertices
    names = [] if vertices is None else [name for name, _ in vertices.columns]
    if vertices is None or not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names):
        if any("packed_position" in dict(item.columns) for item in header.elements):
            raise MemoryFileError(
                f"{path}: Gaussians compressed as SuperSplat does; expected points; save it again "
                "as uncompressed PLY"
            )
        raise MemoryFileError(
            f"{path}: PLY header whose first element has no distinct vertex properties x, y, z; "
            "expected a point cloud"
        )
    return vertices


def read_ply(path: Path, *, strict: bool = True) -> NDArray[np.void]:
    """The vertices of a PLY as a structured array.

    ``strict`` expects a little-endian binary one of points alone. Otherwise text, the other byte
    order and elements behind the vertices are read, too; numbers of a text become float64.
    """
    header = read_header(path)
    vertices = point_vertices(path, header)
    alone = not any(item.count for item in header.elements if item is not vertices)
    if strict and not (header.order == "<" and alone):
        raise MemoryFileError(
            f"{path}: a PLY as text, of another byte order or with more than points; expected one "
            "vertex element in binary_little_endian 1.0"
        )
    dtype, found = header.dtype(vertices), path.stat().st_size
    width = dtype.itemsize if header.order else LEAST_TEXT * len(vertices.columns)
    expected = header.offset + vertices.count * width
    if found < expected - (not header.order) or (header.order and alone and found != expected):
        raise MemoryFileError(
            f"{path}: {found} bytes, but its header says {vertices.count} vertices of "
            f"{width} bytes, that is {expected}; the file is truncated or damaged"
        )
    if header.order:
        return np.fromfile(path, dtype, vertices.count, offset=header.offset)
    with path.open("rb") as file:
        file.seek(header.offset)
        lines = islice((line for line in file if line.strip()), vertices.count)
        kinds = [(name, "<f8") for name, _ in vertices.columns]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # no lines at all
            rows = np.loadtxt(lines, kinds, comments=None, ndmin=1)
    if len(rows) != vertices.count:
        raise MemoryFileError(
            f"{path}: {len(rows)} lines of numbers, but its header says {vertices.count} vertices; "
            "the file is truncated or damaged"
        )
    return np.asarray(rows)


def write_ply(
    path: Path,
    vertices: NDArray[np.void],
    *,
    more: Iterable[NDArray[np.void]] = (),
    count: int | None = None,
    faces: NDArray[np.int32] | None = None,
    comments: Iterable[str] = (),
) -> None:
    """Write a structured array as the vertices of a little-endian binary PLY.

    Args:
        vertices: (N,) the first of them.
        more: further ones, written as they come.
        count: of all; None for N.
        faces: (F, 3) triangles of them.
    """
    # Comments come last: some readers of Gaussians take the third line for the count.
    lines = ["ply", "format binary_little_endian 1.0"]
    lines.append(f"element vertex {len(vertices) if count is None else count}")
    names = vertices.dtype.names or ()
    lines += [f"property {NAMES[vertices.dtype[name].str[1:]]} {name}" for name in names]
    behind = np.empty(0 if faces is None else len(faces), TRIANGLE)
    if faces is not None:
        behind["count"], behind["rows"] = 3, faces
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines += [*(f"comment {c}" for c in comments), "end_header\n"]
    with replaced_when_written(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        for part in chain([vertices], more, [behind]):
            part.tofile(file)


def up_comment(up: NDArray[np.float64] | None) -> tuple[str, ...]:
    """The line of a file's header that tells what is up; none where nothing is known."""
    return () if up is None else ("up " + " ".join(repr(float(x)) for x in up),)
