"""Meshes and clouds in PLY, GLB, OBJ and USD, read under the guards of untrusted files.

trimesh believes a header's counts, makes zeros for arrays that a GLB claims and does not hold, and
copies a mesh as often as a GLB's nodes name it. OpenUSD ends its process on some damaged files: it
reads in a child process.
"""

from __future__ import annotations

import io
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import rigid_poses
from gvtools.errors import MemoryFileError
from gvtools.glb import (
    GLB,
    GLTF_ENDS,
    glb_array,
    glb_axes,
    join_glb,
    read_gltf,
    split_glb,
    srgb_bytes,
)
from gvtools.optional import require
from gvtools.ply import read_header
from gvtools.sandbox import ReaderError, read_apart
from gvtools.scenes.images import IMAGE_SUFFIXES
from gvtools.splat_files import USD, told_by
from gvtools.untrusted import PIXEL_BYTES, PIXEL_RATIO, read_bytes, read_text

if TYPE_CHECKING:
    import trimesh

# What a vertex of a GLB takes in RAM, and how much there may be beside twice the file.
VERTEX_BYTES, SPARE_BYTES = 128, 96 << 20
# Of points without a colour.
GREY = 160
# Of colours that are linear, by their number in glTF: 16 bits and float.
COLOR_TYPES = (5123, 5126)


def load_mesh(path: Path) -> trimesh.Trimesh | trimesh.PointCloud:
    """The triangles or the points of a file, in one, before an export turned them upright."""
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    data = join_glb(*read_gltf(path)) if kind == "gltf" else read_bytes(path)
    if data.startswith(b"ply"):
        read_header(path)
    place: Any = path
    back, size, absent = np.eye(3), len(data), list[str]()
    if data.startswith(GLB):
        place, kind = io.BytesIO(_checked_glb(path, data)), "glb"
        _, back = glb_axes(split_glb(data)[0])
    del data
    # No texture is opened whose pixels the file's size does not explain.
    with patch("PIL.Image.MAX_IMAGE_PIXELS", _most_pixels(size)):
        beside = _beside(path, absent)
        scene = trimesh.load_scene(place, process=False, resolver=beside, file_type=kind)
        loaded: Any = scene.to_geometry()
    pictures = [name for name in absent if name.lower().endswith(IMAGE_SUFFIXES)]
    if pictures and loaded.visual.kind != "vertex":
        raise MemoryFileError(f"{path}: its picture {pictures[0]!r} is absent; copy it beside it")
    loaded.apply_transform(rigid_poses(back))
    whole = isinstance(loaded, trimesh.PointCloud)
    if isinstance(loaded, trimesh.Trimesh) and len(loaded.faces):
        whole = loaded.faces.min() >= 0 and loaded.faces.max() < len(loaded.vertices)
    if not (whole and np.isfinite(loaded.vertices).all()):
        raise MemoryFileError(
            f"{path}: expected points, or triangles of vertices that are there, all finite; save "
            "it again"
        )
    geometry: trimesh.Trimesh | trimesh.PointCloud = loaded
    return geometry


def told_up(path: Path) -> NDArray[np.float64] | None:
    """(3,) what is up, as a PLY, an OBJ or a glTF says; None where it does not."""
    suffix, comments = path.suffix.lower(), tuple[str, ...]()
    if suffix in GLTF_ENDS:
        return glb_axes(read_gltf(path)[0])[0]
    if suffix == ".ply":
        comments = read_header(path).comments
    elif suffix == ".obj":
        lines = takewhile(
            lambda line: line.startswith("#"), read_text(path, errors="replace").splitlines()
        )
        comments = tuple(line[1:].strip() for line in lines)
    return told_by(comments).get("up")


def _beside(path: Path, absent: list[str]) -> Any:
    """What reads files that ``path`` names below its folder, no pipes; ``absent`` gets others."""
    from PIL import Image
    from trimesh.resolvers import FilePathResolver

    class Beside(FilePathResolver):
        def get(self, name: str) -> bytes:
            try:
                file = Path(self.absolute(name))
                data = read_bytes(file if file.is_file() else Path(self.absolute(unquote(name))))
            except OSError:
                absent.append(name)  # trimesh goes on without it
                raise
            # A texture in a file of its own may have the pixels that this file explains.
            Image.MAX_IMAGE_PIXELS = max(Image.MAX_IMAGE_PIXELS or 0, _most_pixels(len(data)))
            return data

    return Beside(str(path))


def _most_pixels(size: int) -> int:
    """Half of the pixels that a file of so many bytes may hold: Pillow refuses twice as many."""
    # A pixel takes up to four bytes.
    return (PIXEL_BYTES + PIXEL_RATIO * size) // 8


def _checked_glb(path: Path, data: bytes) -> bytes:
    """A GLB with colours as trimesh takes them.

    Arrays that are not in the file are refused, and more copies of meshes than it explains.
    """
    try:
        tree, body = split_glb(data)
        counts = []
        for accessor in tree.get("accessors", ()):
            count = accessor["count"]
            if type(count) is not int or not 0 <= count <= len(data):
                raise ValueError(f"an array of {str(count)[:20]} items")
            if "bufferView" not in accessor:
                raise ValueError("an array without data")
            counts.append(count)
        sizes = [
            sum(counts[part["attributes"]["POSITION"]] for part in mesh["primitives"])
            for mesh in tree.get("meshes", ())
        ]
        nodes = tree.get("nodes", ())
        vertices = sum(sizes[node["mesh"]] for node in nodes if "mesh" in node)
        # Vertices that are drawn once take at least 6 bytes of the file; copies take none.
        if (vertices - len(data) // 6) * VERTEX_BYTES > SPARE_BYTES:
            raise ValueError(f"nodes draw {vertices} vertices")
        return _with_plain_colors(tree, body) or data
    except MemoryFileError as error:
        raise MemoryFileError(f"{path}: {error}") from None
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise MemoryFileError(
            f"{path}: no GLB of meshes or points ({error}); the file is damaged; save it again"
        ) from None


def _with_plain_colors(tree: dict[str, Any], body: bytes) -> bytes | None:
    """A GLB whose colours of vertices are bytes of sRGB; None where there are no others.

    glTF has linear light. Bytes stay what they are, as most programs write sRGB in them.
    """
    places = set()
    for part in (part for mesh in tree.get("meshes", ()) for part in mesh["primitives"]):
        if "COLOR_0" in part["attributes"]:
            places.add(part["attributes"]["COLOR_0"])
            # trimesh gives up colours for a material, even one without a texture.
            material = tree["materials"][part["material"]] if "material" in part else {}
            if "baseColorTexture" not in material.get("pbrMetallicRoughness", {}):
                part.pop("material", None)
    most = 2 * len(body)  # colours that do not overlap take less as bytes than as they were
    changed = False
    for place in sorted(places):
        accessor = tree["accessors"][place]
        if accessor["componentType"] not in COLOR_TYPES:
            continue
        stored = glb_array(tree, body, place)
        kind = stored.dtype
        linear = np.nan_to_num(stored.astype(np.float64) / (65535 if kind.kind == "u" else 1))
        colors = np.full((len(linear), 4), 255, np.uint8)
        colors[:, :3] = srgb_bytes(linear[:, :3])
        accessor |= {"bufferView": len(tree["bufferViews"]), "byteOffset": 0, "type": "VEC4"}
        accessor |= {"componentType": 5121, "normalized": True}
        body = body.ljust(-(-len(body) // 4) * 4, b"\0")
        place_of = {"buffer": 0, "byteOffset": len(body), "byteLength": colors.nbytes}
        tree["bufferViews"].append(place_of)
        body += colors.tobytes()
        if len(body) > most:
            raise ValueError("colours that overlap")
        changed = True
    if not changed:
        return None
    tree["buffers"][0]["byteLength"] = len(body)
    return join_glb(tree, body)


def read_usd(
    path: Path,
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.float64] | None]:
    """(N, 3) positions and colours of all UsdGeom.Points, in the file's frame; (3,) what is up."""
    require("pxr", extra="export", purpose=f"{path}: {path.suffix}")
    try:
        (facts, _), *items = read_apart(USD, path)
        parts = [arrays for _, arrays in items if "positions" in arrays]
        grey = np.full((1, 3), GREY / 255)
        colors = [np.broadcast_to(part.get("colors", grey), part["positions"].shape)
                  for part in parts]  # fmt: skip
        positions = np.concatenate([part["positions"] for part in parts])
        up = None if facts["up"] is None else np.array(facts["up"])
        return positions, srgb_bytes(np.concatenate(colors)), up
    except (ReaderError, OSError, ValueError, KeyError):
        raise MemoryFileError(
            f"{path}: no USD with whole Gaussians or UsdGeom.Points, or one that is damaged or "
            "names other files; expected a file as gvtools export writes it; export it again"
        ) from None
