"""Hand-made levels: Quake 3's compiled maps (IBSP, version 46) as textured, lit triangles.

The format is that of id Software's Quake III Arena, whose source is public. A map's faces are
polygons, meshes and quadratic Bézier patches; light is baked into maps of 128 x 128 pixels, or into
vertices. Maps and pictures lie in ``pk3`` files, which are zip archives. What is translucent, not
drawn, or a flare is left out.
"""

from __future__ import annotations

import re
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError

Float32 = NDArray[np.float32]
LUMPS = 17
ENTITIES, TEXTURES, VERTICES, MESH_VERTICES, FACES, LIGHTMAPS = 0, 1, 10, 11, 13, 14
LIGHTMAP = 128
POLYGON, PATCH, MESH = 1, 2, 3
# Flags of a surface, and of what it encloses.
SKY, NOT_DRAWN, TRANSLUCENT = 0x4, 0x80, 0x20000000
# Spans of a Bézier patch along each side.
SPANS = 4
VERTEX = np.dtype(
    [("position", "<f4", 3), ("uv", "<f4", 2), ("light_uv", "<f4", 2), ("normal", "<f4", 3),
     ("color", "u1", 4)]
)  # fmt: skip
FACE = np.dtype(
    [("texture", "<i4"), ("effect", "<i4"), ("kind", "<i4"), ("vertex", "<i4"),
     ("vertices", "<i4"), ("mesh_vertex", "<i4"), ("mesh_vertices", "<i4"), ("lightmap", "<i4"),
     ("light_place", "<i4", 4), ("light_frame", "<f4", 9), ("normal", "<f4", 3),
     ("size", "<i4", 2)]
)  # fmt: skip
TEXTURE = np.dtype([("name", "S64"), ("flags", "<i4"), ("contents", "<i4")])


@dataclass(frozen=True, eq=False)
class Level:
    """A map's triangles, z up, in the map's units (some 40 to the metre).

    Attributes:
        positions: (N, 3) of the vertices.
        uv: (N, 2) in pictures, which repeat.
        light_uv: (N, 2) in the lightmap, [0, 1].
        colors: (N, 3) baked light of the vertices, [0, 1].
        triangles: (T, 3) vertices.
        material: (T,) rows of ``materials``.
        lightmap: (T,) rows of ``lightmaps``; -1 where the vertices have the light.
        materials: names of surfaces.
        sky: (M,) which of them are the sky.
        lightmaps: (L, 128, 128, 3) uint8.
        starts: (S, 3) where players appear.
    """

    positions: Float32
    uv: Float32
    light_uv: Float32
    colors: Float32
    triangles: NDArray[np.int64]
    material: NDArray[np.int64]
    lightmap: NDArray[np.int64]
    materials: tuple[str, ...]
    sky: NDArray[np.bool_]
    lightmaps: NDArray[np.uint8]
    starts: Float32


class Archives:
    """The files of all ``pk3`` archives below a folder, by lower-case path.

    Args:
        folder: searched with its folders; of two files of one path the later archive's counts.

    Raises:
        ProjectError: no archive with a map.
    """

    def __init__(self, folder: Path) -> None:
        self._files: dict[str, tuple[zipfile.ZipFile, str]] = {}
        for path in sorted(folder.rglob("*.pk3")):
            try:
                archive = zipfile.ZipFile(path)
            except (OSError, zipfile.BadZipFile) as error:
                raise ProjectError(f"{path}: not a pk3 archive ({error}); fetch it again") from None
            self._files |= {name.lower(): (archive, name) for name in archive.namelist()}
        self.maps = tuple(sorted(name for name in self._files if name.endswith(".bsp")))
        if not self.maps:
            raise ProjectError(
                f"{folder}: no .pk3 archive with a .bsp map below it; expected the unpacked "
                "packages openarena-data, openarena-081-maps and openarena-081-textures"
            )

    def __contains__(self, name: str) -> bool:
        return name in self._files

    def names(self, ending: str) -> list[str]:
        """Paths with an ending, in order."""
        return sorted(name for name in self._files if name.endswith(ending))

    def read(self, name: str) -> bytes:
        """A file's bytes."""
        archive, stored = self._files[name]
        return archive.read(stored)


def read_level(data: bytes, name: str = "map") -> Level:
    """The triangles of a compiled map.

    Args:
        data: the ``.bsp`` file's bytes.
        name: of it, for messages.

    Raises:
        ProjectError: another format, or a file that ends too early.
    """
    if len(data) < 8 + 8 * LUMPS or data[:8] != b"IBSP" + struct.pack("<i", 46):
        raise ProjectError(f"{name}: begins with {data[:8]!r}; expected IBSP, version 46")
    lumps = []
    for number in range(LUMPS):
        offset, length = struct.unpack_from("<ii", data, 8 + 8 * number)
        if offset < 0 or length < 0 or offset + length > len(data):
            raise ProjectError(f"{name}: ends at byte {len(data)}, before its part {number} does")
        lumps.append(data[offset : offset + length])
    try:
        return _level(lumps)
    except (ValueError, IndexError) as error:
        raise ProjectError(f"{name}: damaged ({error}); expected a map of Quake III") from None


def _level(lumps: list[bytes]) -> Level:
    vertices = np.frombuffer(lumps[VERTICES], VERTEX)
    mesh_vertices = np.frombuffer(lumps[MESH_VERTICES], "<i4").astype(np.int64)
    textures = np.frombuffer(lumps[TEXTURES], TEXTURE)
    lightmaps = np.frombuffer(lumps[LIGHTMAPS], np.uint8).reshape(-1, LIGHTMAP, LIGHTMAP, 3)
    hidden = (textures["flags"] & NOT_DRAWN > 0) | (textures["contents"] & TRANSLUCENT > 0)
    sky = textures["flags"] & SKY > 0
    attributes = _attributes(vertices)
    pieces, triangles, faces = [attributes], [], []
    total = len(attributes)
    for face in np.frombuffer(lumps[FACES], FACE):
        first, kind = int(face["vertex"]), int(face["kind"])
        if hidden[face["texture"]] and not sky[face["texture"]]:
            continue
        if kind == PATCH:
            width, height = (int(side) for side in face["size"])
            control = attributes[first : first + width * height].reshape(height, width, -1)
            points, joined = _patch(control)
            pieces.append(points)
            triangles.append(joined + total)
            total += len(points)
        elif kind in (POLYGON, MESH):
            begin, count = int(face["mesh_vertex"]), int(face["mesh_vertices"])
            triangles.append(first + mesh_vertices[begin : begin + count].reshape(-1, 3))
        else:
            continue
        light = int(face["lightmap"])
        light = light if 0 <= light < len(lightmaps) else -1
        faces += [(int(face["texture"]), light)] * len(triangles[-1])
    values = np.concatenate(pieces)
    joined = np.concatenate(triangles) if triangles else np.zeros((0, 3), np.int64)
    if joined.size and not 0 <= joined.min() <= joined.max() < len(values):
        raise IndexError("a triangle names an absent vertex")
    of_face = np.array(faces, np.int64).reshape(-1, 2)
    positions, uv, light_uv, colors = np.split(values, (3, 5, 7), axis=1)
    names = tuple(name.decode("latin1").lower() for name in textures["name"])
    return Level(
        positions, uv, light_uv, colors, joined, of_face[:, 0], of_face[:, 1], names, sky,
        lightmaps, _starts(lumps[ENTITIES].decode("latin1")),
    )  # fmt: skip


def _attributes(vertices: NDArray[np.void]) -> Float32:
    """(N, 10): position, place in the picture and in the lightmap, colour."""
    colors = vertices["color"][:, :3] / np.float32(255)
    parts = (vertices["position"], vertices["uv"], vertices["light_uv"], colors)
    return np.concatenate(parts, axis=1).astype(np.float32)


def _patch(control: Float32) -> tuple[Float32, NDArray[np.int64]]:
    """Points and triangles of joined biquadratic Bézier patches.

    Args:
        control: (H, W, C) control points, H and W odd.
    """
    height, width, channels = control.shape
    t = np.linspace(0, 1, SPANS + 1)
    basis = np.stack([(1 - t) ** 2, 2 * t * (1 - t), t**2], axis=1)
    points: list[Float32] = []
    triangles: list[NDArray[np.int64]] = []
    row, column = np.divmod(np.arange(SPANS * SPANS), SPANS)
    corner = row * (SPANS + 1) + column
    below = corner + SPANS + 1
    quads = np.concatenate(
        [np.stack([corner, below, corner + 1], 1), np.stack([corner + 1, below, below + 1], 1)]
    )
    for y in range(0, height - 2, 2):
        for x in range(0, width - 2, 2):
            nine = control[y : y + 3, x : x + 3]
            triangles.append(quads + len(points) * (SPANS + 1) ** 2)
            points.append(np.einsum("ai,bj,ijc->abc", basis, basis, nine).reshape(-1, channels))
    if not points:
        return np.zeros((0, channels), np.float32), np.zeros((0, 3), np.int64)
    return np.concatenate(points).astype(np.float32), np.concatenate(triangles)


def _starts(entities: str) -> Float32:
    """(S, 3) the places of players in the map's list of things."""
    found = []
    for block in re.findall(r"\{([^}]*)\}", entities):
        keys = dict(re.findall(r'"([^"]*)"\s*"([^"]*)"', block))
        kind = keys.get("classname", "")
        if kind in ("info_player_deathmatch", "info_player_start") and "origin" in keys:
            found.append([float(value) for value in keys["origin"].split()])
    return np.array(found, np.float32).reshape(-1, 3)
