"""glTF, binary or as text: its JSON and its bytes, and the arrays that the JSON says are there."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.untrusted import named_file, other_version, parse_json, read_bytes, reading

GLTF_ENDS = (".glb", ".gltf")
GLB, JSON, BIN, VERSION = b"glTF", b"JSON", b"BIN\0", 2
# By their number in glTF, and how many make one item.
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
NUMBERS = {np.dtype(kind): number for number, kind in TYPES.items()}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
ITEMS = {width: name for name, width in WIDTHS.items()}
# The node by which an exported glTF stands upright.
UPRIGHT = "gvtools_upright"
# What glTF and USD tell to be up where an export did not know it.
UNKNOWN = [0.0, 0.0, 0.0]


def read_gltf(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the bytes of a file; of a ``.gltf`` those of all its buffers, as in a GLB."""
    if path.suffix.lower() != ".gltf":
        return split_glb(read_bytes(path))
    tree, starts, body = parse_json(read_bytes(path)), dict[str, int](), bytearray()
    uris = [buffer["uri"] for buffer in tree.get("buffers", ())]
    for uri in dict.fromkeys(uris):
        starts[uri] = len(body)
        if uri.startswith("data:"):
            body += base64.b64decode(uri.partition(",")[2])
        else:
            with reading(f"{path}: its buffer {uri[:80]!r}", "expected a file beside it"):
                body += read_bytes(named_file(path.parent, unquote(uri), where=str(path)))
        body += bytes(-len(body) % 4)
    for view in tree.get("bufferViews", ()):
        start = starts[uris[view.get("buffer", 0)]]
        view |= {"buffer": 0, "byteOffset": start + view.get("byteOffset", 0)}
    return {**tree, "buffers": [{"byteLength": len(body)}]}, bytes(body)


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


def pack_glb(
    attributes: Mapping[str, NDArray[Any]],
    *,
    node: dict[str, Any],
    primitive: dict[str, Any],
    around: dict[str, Any] | None = None,
    indices: NDArray[np.uint32] | None = None,
    picture: bytes = b"",
    **tree: Any,
) -> bytes:
    """A GLB of one node with one primitive, in a node ``around`` it if there is one.

    Args:
        attributes: (N, W) each; whole numbers stand for shares of 1.
        node, primitive: what they say beside that.
        indices: (F, 3) of triangles.
        picture: a PNG, the file's texture 0.
        tree: what the file says beside that.
    """
    arrays = {**attributes}
    if indices is not None:
        primitive = {**primitive, "indices": len(arrays)}
        arrays["indices"] = indices.reshape(-1, 1)
    views, accessors, body = list[Any](), list[Any](), bytearray()
    for name, array in arrays.items():
        whole = array.dtype.kind != "f" and name != "indices"
        accessors.append(
            {"bufferView": len(views), "componentType": NUMBERS[array.dtype], "count": len(array),
             "type": ITEMS[array.shape[1]], "normalized": whole,
             "min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        )  # fmt: skip
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": array.nbytes})
        body += np.ascontiguousarray(array).tobytes()
    if picture:
        tree |= {"textures": [{"source": 0}],
                 "images": [{"bufferView": len(views), "mimeType": "image/png"}]}  # fmt: skip
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(picture)})
        body += picture
    primitive |= {"attributes": {name: place for place, name in enumerate(attributes)}}
    tree |= {
        "asset": {"version": "2.0", "generator": "gvtools"},
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{**node, "mesh": 0}],
        "meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }  # fmt: skip
    if around:
        tree["nodes"].append({**around, "children": [0]})
        tree["scenes"] = [{"nodes": [1]}]
    return join_glb(tree, bytes(body))


def drawn_nodes(tree: dict[str, Any]) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    """The nodes of the scene, and (4, 4) from the frame of each to the scene's."""
    from scipy.spatial.transform import Rotation

    nodes, scenes = tree.get("nodes", []), tree.get("scenes")
    inner = {child for node in nodes for child in node.get("children", ())}
    outer = sorted({*range(len(nodes))} - inner)
    first = scenes[tree.get("scene", 0)].get("nodes", ()) if scenes else outer
    rest = [(number, np.eye(4)) for number in first]
    for number, above in rest:
        node, own = nodes[number], np.eye(4)
        if "matrix" in node:
            own = np.array(node["matrix"], np.float64).reshape(4, 4).T
        else:
            turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
            own[:3, :3] = turn * np.asarray(node.get("scale", (1, 1, 1)), np.float64)
            own[:3, 3] = node.get("translation", (0, 0, 0))
        yield node, above @ own
        rest += [(child, above @ own) for child in node.get("children", ())]
        if len(rest) > len(nodes):
            raise ValueError("a node in several places")


def glb_array(tree: dict[str, Any], body: bytes, place: int) -> NDArray[Any]:
    """(N, W) the array of an accessor as it is stored, no more than there is."""
    accessor = tree["accessors"][place]
    kind, width, count = _kind(accessor), WIDTHS[accessor["type"]], accessor["count"]
    if "bufferView" in accessor:
        array = _stored(tree, body, accessor, kind=kind, shape=(count, width))
    elif not 0 <= count * width * kind.itemsize <= len(body):
        raise ValueError(f"an array of {count} items")
    else:
        array = np.zeros((count, width), kind)
    if "sparse" in accessor:
        sparse, array = accessor["sparse"], array.copy()
        rows, values = sparse["indices"], sparse["values"]
        shape = (sparse["count"], width)
        rows = _stored(tree, body, rows, kind=_kind(rows), shape=(sparse["count"], 1))[:, 0]
        array[rows] = _stored(tree, body, values, kind=kind, shape=shape)
    return array


def _kind(accessor: dict[str, Any]) -> np.dtype[Any]:
    return np.dtype(TYPES[accessor["componentType"]])


def _stored(
    tree: dict[str, Any],
    body: bytes,
    holder: dict[str, Any],
    *,
    kind: np.dtype[Any],
    shape: tuple[int, int],
) -> NDArray[Any]:
    """The items that a view holds, from where ``holder`` says."""
    view = tree["bufferViews"][holder["bufferView"]]
    if view.get("buffer", 0) != 0:
        raise ValueError("an array in another file")
    start = view.get("byteOffset", 0) + holder.get("byteOffset", 0)
    step = view.get("byteStride") or shape[1] * kind.itemsize
    if not 0 <= start <= len(body) or step < shape[1] * kind.itemsize:
        raise ValueError("an array outside of the file")
    return np.ndarray(shape, kind, body, start, (step, kind.itemsize))


def glb_numbers(tree: dict[str, Any], body: bytes, place: int) -> NDArray[np.float32]:
    """(N, W) the same as numbers: whole ones that stand for shares of 1 are divided."""
    stored = glb_array(tree, body, place)
    if stored.dtype.kind == "f" or not tree["accessors"][place].get("normalized", False):
        return stored.astype(np.float32)
    return np.maximum(stored / np.float32(np.iinfo(stored.dtype).max), -1).astype(np.float32)


def glb_colors(tree: dict[str, Any], body: bytes, place: int) -> NDArray[np.uint8]:
    """(N, 3) colours of vertices: linear light, but bytes, in which most programs write sRGB."""
    stored = glb_array(tree, body, place)[:, :3]
    if stored.dtype == np.uint8:
        return stored
    return srgb_bytes(np.nan_to_num(glb_numbers(tree, body, place)[:, :3].astype(np.float64)))


def srgb_bytes(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Linear light as bytes of sRGB."""
    linear = np.clip(linear, 0, 1)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(255 * curved).astype(np.uint8)


def unit(told: Any, size: int = 3) -> NDArray[np.float64] | None:
    """A direction or a quaternion of length 1; None for what it is not, as of other programs."""
    try:
        vector = np.asarray(told, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    length = float(np.linalg.norm(vector)) if vector.shape == (size,) else 0.0
    return vector / length if 0 < length < np.inf else None


def turn_back(turn: Any) -> NDArray[np.float64]:
    """(3, 3) from the upright axes of an exported file to the input's, see ``turn_upright``."""
    turn = unit(turn, 4)
    if turn is None:
        return np.eye(3)
    # Without scipy, which the child process may not load any more.
    cross = np.cross(np.eye(3), turn[:3])
    return np.asarray(np.eye(3) - 2 * turn[3] * cross + 2 * cross @ cross)


def glb_axes(tree: Mapping[str, Any]) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
    """(3,) what is up in a glTF: what a node's extras say, else y, as the standard has it.

    It is in the axes that the scene had before an export turned it upright; beside it (3, 3) from
    the scene's axes to those.

    >>> glb_axes({"nodes": [{"extras": {"up": [0, 0, 2]}}]})[0]
    array([0., 0., 1.])
    """
    nodes = list(drawn_nodes(dict(tree)))
    for node, matrix in nodes:
        told = extras if isinstance(extras := node.get("extras"), dict) else {}
        up = unit(told.get("up"))
        if told.get("up") == UNKNOWN:
            return None, np.eye(3)
        if up is not None:
            shown = unit(matrix[:3, :3] @ up)
            # A node taken out of the one that turns it has the axes from before.
            turned = shown is not None and shown[1] > shown @ up
            back = turn_back(told.get("turn") if turned else None)
            return None if shown is None else back @ shown, back
    # Many programs keep the node that turns, but no extras.
    turns = [matrix[:3, :3] for node, matrix in nodes if node.get("name") == UPRIGHT]
    back = turns[0].T / np.cbrt(np.linalg.det(turns[0])) if turns else np.eye(3)
    return back[:, 1], back
