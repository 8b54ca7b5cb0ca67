"""Binary glTF: its JSON and its bytes, and the arrays that the JSON says are in them."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.untrusted import other_version, parse_json

GLB, JSON, BIN, VERSION = b"glTF", b"JSON", b"BIN\0", 2
# By their number in glTF, and how many make one item.
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the bytes behind it; ValueError for what is no GLB."""
    version = int.from_bytes(data[4:8], "little")
    if data.startswith(GLB) and version > VERSION:
        raise MemoryFileError(
            f"glTF version {version}; expected {VERSION}; {other_version(version, VERSION, '')}"
        )
    try:
        length, kind = struct.unpack_from("<I4s", data, 12)
    except struct.error:
        raise ValueError("it ends early") from None
    if not data.startswith(GLB) or kind != JSON or 20 + length > len(data):
        raise ValueError("no JSON in front")
    tree = parse_json(data[20 : 20 + length])
    if not isinstance(tree, dict):
        raise ValueError("JSON that is no object")
    return tree, data[28 + length :]


def join_glb(tree: dict[str, Any], body: bytes) -> bytes:
    """A GLB of a JSON and its bytes."""
    head = json.dumps(tree).encode()
    head, body = head.ljust(-(-len(head) // 4) * 4), body.ljust(-(-len(body) // 4) * 4, b"\0")
    size = 28 + len(head) + len(body)
    parts = (struct.pack("<4sIII4s", GLB, VERSION, size, len(head), JSON), head,
             struct.pack("<I4s", len(body), BIN), body)  # fmt: skip
    return b"".join(parts)


def glb_array(tree: dict[str, Any], body: bytes, place: int) -> NDArray[Any]:
    """(N, W) the array of an accessor as it is stored, no more than there is."""
    accessor = tree["accessors"][place]
    view = tree["bufferViews"][accessor["bufferView"]]
    if view.get("buffer", 0) != 0 or "sparse" in accessor:
        raise ValueError("an array that is sparse, or in another file")
    kind, width = np.dtype(TYPES[accessor["componentType"]]), WIDTHS[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    step = view.get("byteStride") or width * kind.itemsize
    if not 0 <= start <= len(body) or step < width * kind.itemsize:
        raise ValueError("an array outside of the file")
    return np.ndarray((accessor["count"], width), kind, body, start, (step, kind.itemsize))


def glb_numbers(tree: dict[str, Any], body: bytes, place: int) -> NDArray[np.float32]:
    """(N, W) the same as numbers: whole ones that stand for shares of 1 are divided."""
    stored = glb_array(tree, body, place)
    if stored.dtype.kind == "f" or not tree["accessors"][place].get("normalized", False):
        return stored.astype(np.float32)
    return np.maximum(stored / np.float32(np.iinfo(stored.dtype).max), -1).astype(np.float32)
