"""What surfaces of a procedural scene look like: normals, light, filtered textures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.procedural.geometry import Geometry
from gvtools.procedural.mesh import ROUND, Mesh
from gvtools.procedural.ray_cast import tracer

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# A surface point is lifted by so much off its surface, or it would shade itself. [metres]
LIFT = 2e-4


@dataclass(frozen=True, eq=False)
class Light:
    """What lights a scene. Colours are linear light.

    Attributes:
        ambient: (2, 3) light from above and from below.
        sun: (2, 3) direction towards it (unit length), and its light.
        lamps: (L, 2, 3) position, and its light on a surface that faces it from half its reach.
        reach: metres; a lamp's light falls off as 1 / (1 + (distance / reach)²).
        shadows: whether solids and walls keep the lamps' light away.
    """

    ambient: Float64
    sun: Float64
    lamps: Float64
    reach: float
    shadows: bool


@dataclass(frozen=True, eq=False)
class Look:
    """Materials and light. Colours are linear light.

    Attributes:
        texture: (P,) row of ``levels``.
        tile: (P, 2) length that one copy of the texture covers, metres.
        offset: (P, 2) of the texture's corner, metres.
        gain: (P, 3) factor on the texture.
        emission: (P,) light of the surface's own, for what lies outside windows.
        levels: of all textures, see ``textures.stacked``.
        light: see Light.
    """

    texture: Int64
    tile: Float64
    offset: Float64
    gain: Float64
    emission: Float64
    levels: tuple[Float32, ...]
    light: Light


def colors(geometry: Geometry, look: Look, rays: Float32, pixel: float) -> Float32:
    """(N, 3) linear light that rays (N, 6) of z-depth 1 bring; black where they meet nothing.

    Args:
        geometry: of the scene.
        look: of the scene.
        rays: origins and directions.
        pixel: width of a ray's share of the image at z-depth 1.
    """
    scene = tracer(geometry)
    t, triangle, normal = scene.first(rays)
    missed = ~np.isfinite(t)
    t = np.where(missed, np.float32(1), t)
    # From here on (3, N), whose rows numpy goes through fastest.
    normal, origins, directions = normal.T.copy(), rays[:, :3].T, rays[:, 3:].T.copy()
    points = origins + t * directions
    place, length = _texture_place(geometry, scene.mesh, triangle, points, normal)
    facing = -_dot(normal, directions)
    normal *= np.sign(facing)

    material = scene.mesh.material[triangle]
    # Round coordinates are in half turns, which a copy covers whatever the tile is.
    tile = np.where(length == 1, look.tile.T.astype(np.float32)[:, material], np.float32(1))
    copies = (place - look.offset.T.astype(np.float32)[:, material]) / tile
    spread = np.prod(length / tile, axis=0) / np.maximum(np.abs(facing), np.float32(1e-3))
    texel = np.float32(pixel * look.levels[0].shape[1])
    level = np.log2(np.maximum(t * np.sqrt(spread) * texel, np.float32(1e-6)))
    texels = _sampled(look.levels, look.texture[material], copies.astype(np.float32), level)

    light = _light(geometry, look.light, points, normal)
    light += look.emission.astype(np.float32)[material]
    light *= look.gain.T.astype(np.float32)[:, material]
    light[:, missed] = 0
    return texels * light.T


def _texture_place(
    geometry: Geometry, mesh: Mesh, triangle: Int64, points: Float32, normal: Float32
) -> tuple[Float32, Float32]:
    """Where points lie on their surfaces' textures; puts the normals of round ones into ``normal``.

    Upright flat surfaces have the texture's second axis downwards.

    Args:
        geometry: of the scene.
        mesh: of the scene.
        triangle: (N,) that points lie on.
        points: (3, N) world frame.
        normal: (3, N), changed.

    Returns:
        The place (2, N) before tile and offset, and its lengths a metre (2, N), 1 where it is in
        metres.
    """
    solid, kind = mesh.solid[triangle], mesh.kind[triangle]
    x, y, z = local = points.copy()
    for number in np.unique(solid[solid >= 0]):
        own = np.flatnonzero(solid == number)
        local[:, own] = geometry.solids[number].local(points[:, own].T).T
    place = np.stack([np.where(kind == 0, y, x), np.where(kind == 2, y, -z)])
    length = np.ones_like(place)
    for number in np.unique(solid[kind >= ROUND]):
        body = geometry.solids[number]
        own = np.flatnonzero((solid == number) & (kind >= ROUND))
        ball = kind[own[0]] == ROUND
        scaled = local[:, own] / body.half[:, None]
        gradient = scaled / body.half[:, None] * [[1], [1], [ball]]
        normal[:, own] = body.rotation.T @ (gradient / np.linalg.norm(gradient, axis=0))
        # Two mirrored copies of half a turn close round the body without a seam.
        place[0, own] = np.arctan2(scaled[1], scaled[0]) / np.pi
        length[0, own] = 1 / (np.pi * np.sqrt(body.half[0] * body.half[1]))
        if ball:
            place[1, own] = np.arccos(np.clip(scaled[2], -1, 1)) / np.pi
            length[1, own] = 1 / (np.pi * body.half[2])
    return place, length


def _light(geometry: Geometry, source: Light, points: Float32, normal: Float32) -> Float32:
    """(3, N) light on surface points (3, N)."""
    above, below = source.ambient.astype(np.float32)[..., None]
    direction, strength = source.sun.astype(np.float32)
    light = below + (above - below) * (0.5 + 0.5 * normal[2])
    light += np.maximum(direction @ normal, 0) * strength[:, None]
    lifted = points + np.float32(LIFT) * normal
    for place, color in source.lamps.astype(np.float32)[..., None]:
        if not color.any():
            continue
        way = place - points
        squared = _dot(way, way)
        lit = np.maximum(_dot(way, normal), 0) / np.sqrt(squared + np.float32(1e-12))
        lit *= np.float32(1.25) / (1 + squared / np.float32(source.reach**2))
        if source.shadows:
            towards = np.flatnonzero(lit)
            start = lifted[:, towards]
            blocked = tracer(geometry).blocked(np.concatenate([start, place - start]).T.copy())
            lit[towards[blocked]] = 0
        light += lit * color
    return light


def _dot(first: Float32, second: Float32) -> Float32:
    """(N,) of (3, N) vectors."""
    return np.einsum("kn,kn->n", first, second)


def _sampled(levels: tuple[Float32, ...], row: Int64, place: Float32, level: Float32) -> Float32:
    """(N, 3) texels of textures at places, between the two nearest levels of resolution."""
    level = np.clip(level, 0, len(levels) - 1.001)
    fine = level.astype(np.int64)
    share = level - fine
    out = np.zeros((len(row), 3), np.float32)
    for number, texels in enumerate(levels):
        for weight, here in ((1 - share, fine == number), (share, fine == number - 1)):
            own = np.flatnonzero(here)
            if len(own):
                found = _bilinear(texels, row[own], place[:, own])
                out[own] += weight[own, None] * found
    return out


def _bilinear(texels: Float32, row: Int64, place: Float32) -> Float32:
    """(N, 3) of textures (T, S, S, 3) that are tiled with mirrored copies."""
    side = texels.shape[1]
    corner = place * side - np.float32(0.5)
    low = np.floor(corner)
    right, lower = (corner - low)[..., None]
    x, y = low.astype(np.int64)

    def mirrored(index: Int64) -> Int64:
        index = index % (2 * side)
        return np.minimum(index, 2 * side - 1 - index)

    x0, x1, y0, y1 = mirrored(x), mirrored(x + 1), mirrored(y), mirrored(y + 1)
    upper_row = texels[row, y0, x0] * (1 - right) + texels[row, y0, x1] * right
    lower_row = texels[row, y1, x0] * (1 - right) + texels[row, y1, x1] * right
    return upper_row * (1 - lower) + lower_row * lower
