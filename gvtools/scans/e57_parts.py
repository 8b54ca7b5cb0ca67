"""The head and the XML part of an E57, checked before libE57 reads them.

libE57 expands entities, by which a kilobyte stands for gigabytes, and holds every element as a node
whose end ends its children in turn, however deep they lie.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from gvtools.errors import MemoryFileError

MAGIC = b"ASTM-E57"
# Signature, version, length of the file, place of the XML part, its length, bytes of a page.
HEAD = struct.Struct("<8sIIQQQQ")
# Each page ends with its checksum.
PAGE, CHECKSUM = 1024, 4
# Deeper than any scan is described, and memory of a node.
MOST_DEPTH, NODE_BYTES, SPARE_BYTES = 64, 1 << 10, 1 << 27


def check_e57(path: Path) -> None:
    """Refuse what libE57 should not see."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEAD.size)
        if not head.startswith(MAGIC) or len(head) < HEAD.size:
            raise MemoryFileError(f"{path}: no E57 header; expected an E57 point cloud")
        _, major, _, told, at, length, page = HEAD.unpack(head)
        if (major, page) != (1, PAGE):
            raise MemoryFileError(
                f"{path}: E57 version {major} with pages of {page} bytes; expected version 1 with "
                f"{PAGE}; save it again"
            )
        if told != size:
            raise MemoryFileError(
                f"{path}: {size} bytes, but its header says {told}; the file is truncated or "
                "damaged; save it again"
            )
        first, within = divmod(at, PAGE)
        pages = -(-(within + length) // (PAGE - CHECKSUM))
        if within >= PAGE - CHECKSUM or (first + pages) * PAGE > size:
            raise MemoryFileError(
                f"{path}: its header says {length} bytes of XML at byte {at} of {size}; the file "
                "is damaged; save it again"
            )
        file.seek(first * PAGE)
        raw = file.read(pages * PAGE)
    parts = [raw[k : k + PAGE - CHECKSUM] for k in range(0, len(raw), PAGE)]
    try:
        _check_xml(b"".join(parts)[within : within + length], SPARE_BYTES + size)
    except (expat.ExpatError, ValueError) as error:
        raise MemoryFileError(
            f"{path}: its XML part is none of an E57 ({error}); the file is damaged; save it again"
        ) from None


def _check_xml(text: bytes, room: int) -> None:
    """Refuse markup that declares entities, another encoding than UTF-8, or too much."""
    if not text.lstrip().startswith(b"<"):
        raise ValueError("no element")
    depth = nodes = 0

    def declared(version: str, encoding: str | None, standalone: int) -> None:
        if (encoding or "utf-8").lower() != "utf-8":
            raise ValueError("another encoding than UTF-8")

    def refuse(*_: object) -> NoReturn:
        raise ValueError("a document type")

    def begin(name: str, attributes: object) -> None:
        nonlocal depth, nodes
        depth, nodes = depth + 1, nodes + 1
        if depth > MOST_DEPTH or nodes * NODE_BYTES > room:
            raise ValueError(f"{nodes} elements, {depth} deep")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.XmlDeclHandler, parser.StartDoctypeDeclHandler = declared, refuse
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.Parse(text, True)
