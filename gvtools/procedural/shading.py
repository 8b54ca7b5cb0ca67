"""What surfaces of a procedural scene look like: normals, place on the texture, filtered colour."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import FAST, compiled

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


class Look(NamedTuple):
    """Materials and light. Colours are linear light.

    Attributes:
        texture: (P,) row of ``texels``.
        tile: (P, 2) length that one copy of the texture covers, metres.
        offset: (P, 2) of the texture's corner, metres.
        gain: (P, 3) factor on the texture.
        emission: (P,) light of the surface's own, for what lies outside windows.
        texels: (T, texels, 3) float32, see ``textures.stacked``.
        starts: (levels + 1,), see ``textures.level_starts``.
        side: texels along a side of the finest level.
        ambient: (2, 3) light from above and from below.
        sun: (2, 3) direction towards it (unit length), and its light.
        lamps: (L, 2, 3) position, and its light on a surface that faces it from half its reach.
        reach: metres; a lamp's light falls off as 1 / (1 + (distance / reach)²).
        shadows: whether solids and walls keep the lamps' light away.
    """

    texture: Int64
    tile: Float64
    offset: Float64
    gain: Float64
    emission: Float64
    texels: Float32
    starts: Int64
    side: int
    ambient: Float64
    sun: Float64
    lamps: Float64
    reach: float
    shadows: bool


@compiled(fastmath=FAST)
def surface_places(geometry, look, d, p, room, solid, code, cutter, normal, what, place, spread):
    """Normals, materials and texture places of what rays with directions ``d`` meet at ``p``.

    Upright flat surfaces have the texture's second axis downwards. ``d``, ``p`` and ``normal`` are
    (3, count); ``place`` (2, count) is in copies of the texture; ``spread`` (count,) gets the
    square of copies a metre, over the cosine between normal and ray (which has z-depth 1).
    """
    for i in range(len(what)):
        if solid[i] < 0:
            c = code[i]
            positive = d[c, i] < 0
            facing = abs(d[c, i])
            for k in range(3):
                normal[k, i] = 0.0
            normal[c, i] = 1.0 if positive else -1.0
            m = geometry.room_material[room[i], 2 * c + (0 if positive else 1)]
            u = p[1, i] if c == 0 else p[0, i]
            v = p[1, i] if c == 2 else -p[2, i]
            along = down = 1.0
        else:
            n = solid[i]
            m = geometry.material[n] if cutter[i] < 0 else geometry.cutter_material[cutter[i]]
            facing, u, v, along, down = _solid_place(geometry, n, code[i], i, d, p, normal)
        # Round coordinates are in half turns, which a copy covers whatever the tile is.
        tu = look.tile[m, 0] if along == 1.0 else 1.0
        tv = look.tile[m, 1] if down == 1.0 else 1.0
        what[i] = m
        place[0, i] = (u - look.offset[m, 0]) / tu
        place[1, i] = (v - look.offset[m, 1]) / tv
        spread[i] = along * down / (tu * tv * max(facing, 1e-3))


@compiled(fastmath=FAST)
def _solid_place(geometry, n, code, i, d, p, normal):
    """Place of point i on solid n; writes its normal.

    Returns the cosine between normal and ray, u and v before tile and offset, and their lengths a
    metre (1 where they are metres).
    """
    R = geometry.rotation
    x = p[0, i] - geometry.centre[n, 0]
    y = p[1, i] - geometry.centre[n, 1]
    z = p[2, i] - geometry.centre[n, 2]
    a = R[n, 0, 0] * x + R[n, 0, 1] * y + R[n, 0, 2] * z
    b = R[n, 1, 0] * x + R[n, 1, 1] * y + R[n, 1, 2] * z
    c = R[n, 2, 0] * x + R[n, 2, 1] * y + R[n, 2, 2] * z
    along = down = 1.0
    if code <= 2:
        mx = 1.0 if code == 0 else 0.0
        my = 1.0 if code == 1 else 0.0
        mz = 1.0 if code == 2 else 0.0
        u = b if code == 0 else a
        v = b if code == 2 else -c
    else:
        hx = geometry.half[n, 0]
        hy = geometry.half[n, 1]
        hz = geometry.half[n, 2]
        mx = a / (hx * hx)
        my = b / (hy * hy)
        mz = c / (hz * hz) if code == 3 else 0.0
        scale = 1.0 / np.sqrt(mx * mx + my * my + mz * mz)
        mx *= scale
        my *= scale
        mz *= scale
        # Two mirrored copies of half a turn close round the body without a seam.
        u = np.arctan2(b / hy, a / hx) / np.pi
        along = 1.0 / (np.pi * np.sqrt(hx * hy))
        v = -c
        if code == 3:
            v = np.arccos(min(max(c / hz, -1.0), 1.0)) / np.pi
            down = 1.0 / (np.pi * hz)
    x = R[n, 0, 0] * mx + R[n, 1, 0] * my + R[n, 2, 0] * mz
    y = R[n, 0, 1] * mx + R[n, 1, 1] * my + R[n, 2, 1] * mz
    z = R[n, 0, 2] * mx + R[n, 1, 2] * my + R[n, 2, 2] * mz
    facing = -(x * d[0, i] + y * d[1, i] + z * d[2, i])
    sign = 1.0 if facing > 0 else -1.0
    normal[0, i] = sign * x
    normal[1, i] = sign * y
    normal[2, i] = sign * z
    return abs(facing), u, v, along, down


@compiled(fastmath=FAST)
def texture_levels(look, t, pixel, spread, squares, level):
    """Level of resolution at which a texel is as wide as a ray's share of the surface.

    ``pixel`` is the ray's share of the image at z-depth 1; ``squares`` (count,) float32 is scratch.
    """
    factor = (pixel * look.side) ** 2
    for i in range(len(t)):
        squares[i] = np.float32(max(t[i] * t[i] * spread[i] * factor, 1e-9))
    coarsest = len(look.starts) - 1 - 1.001
    bits = squares.view(np.int32)
    for i in range(len(t)):
        # A float's exponent is its logarithm's integer part; the mantissa's is near a parabola.
        mantissa = np.float64(bits[i] & 0x7FFFFF) / 8388608.0
        log = np.float64((bits[i] >> 23) - 127) + mantissa * (1.3465 - 0.3465 * mantissa)
        level[i] = min(max(0.5 * log, 0.0), coarsest)


@compiled(inline="always")
def _mirrored(index, side):
    """Texel of a plane tiled with mirrored copies; ``side`` is a power of two."""
    index &= 2 * side - 1
    return 2 * side - 1 - index if index >= side else index


@compiled(fastmath=FAST)
def add_colors(look, what, place, level, light, samples, color):
    """Add texture times light of each ray to its pixel (W, 3); ``samples`` rays a pixel."""
    texels = look.texels
    for i in range(len(what)):
        m = what[i]
        row = look.texture[m]
        fine = np.int64(level[i])
        red = green = blue = np.float32(0)
        for step in range(2):
            coarse = np.float32(level[i] - fine)
            share = coarse if step else np.float32(1) - coarse
            side = look.side >> (fine + step)
            x = place[0, i] * side - 0.5
            y = place[1, i] * side - 0.5
            left = np.floor(x)
            top = np.floor(y)
            fx = np.float32(x - left)
            fy = np.float32(y - top)
            c0 = _mirrored(np.int64(left), side)
            c1 = _mirrored(np.int64(left) + 1, side)
            r0 = look.starts[fine + step] + side * _mirrored(np.int64(top), side)
            r1 = look.starts[fine + step] + side * _mirrored(np.int64(top) + 1, side)
            lower = share * fy
            upper = share - lower
            a = upper - upper * fx
            b = upper * fx
            c = lower - lower * fx
            e = lower * fx
            red += a * texels[row, r0 + c0, 0] + b * texels[row, r0 + c1, 0]
            red += c * texels[row, r1 + c0, 0] + e * texels[row, r1 + c1, 0]
            green += a * texels[row, r0 + c0, 1] + b * texels[row, r0 + c1, 1]
            green += c * texels[row, r1 + c0, 1] + e * texels[row, r1 + c1, 1]
            blue += a * texels[row, r0 + c0, 2] + b * texels[row, r0 + c1, 2]
            blue += c * texels[row, r1 + c0, 2] + e * texels[row, r1 + c1, 2]
        own = look.emission[m]
        col = i // samples
        color[col, 0] += np.float32(red * look.gain[m, 0] * (light[0, i] + own))
        color[col, 1] += np.float32(green * look.gain[m, 1] * (light[1, i] + own))
        color[col, 2] += np.float32(blue * look.gain[m, 2] * (light[2, i] + own))
