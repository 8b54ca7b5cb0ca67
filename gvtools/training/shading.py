"""What surfaces of a procedural scene look like: normals, place on the texture, filtered colour."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.compiled import FAST, compiled
from gvtools.training.textures import LEVELS, OFFSETS, SIDE

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

STARTS = OFFSETS.astype(np.int64)


class Look(NamedTuple):
    """Materials and light. Colours are linear light.

    Attributes:
        texture: (P,) row of ``texels``.
        tile: (P, 2) length that one copy of the texture covers, metres.
        offset: (P, 2) of the texture's corner, metres.
        gain: (P, 3) factor on the texture.
        emission: (P,) light of the surface's own, for what lies outside windows.
        texels: (T, texels, 3) float32, see ``textures.stacked``.
        ambient: (2, 3) light from above and from below.
        sun: (2, 3) direction towards it (unit length), and its light.
        lamp: (2, 3) position, and its light on a surface that faces it from half its reach.
        reach: metres; the lamp's light falls off as 1 / (1 + (distance / reach)²).
        shadows: whether solids and walls keep the lamp's light away.
    """

    texture: Int64
    tile: Float64
    offset: Float64
    gain: Float64
    emission: Float64
    texels: Float32
    ambient: Float64
    sun: Float64
    lamp: Float64
    reach: float
    shadows: bool


@compiled(fastmath=FAST)
def surface_places(geometry, look, d, p, room, solid, code, cutter, normal, what, place, spread):
    """Normals, materials and texture places of what rays with directions ``d`` meet at ``p``.

    Upright flat surfaces have the texture's second axis downwards. ``d``, ``p`` and ``normal`` are
    (3, count); ``place`` (2, count) is in copies of the texture; ``spread`` (count,) gets the
    square of copies a metre, over the cosine between normal and ray (which has z-depth 1).
    """
    rotation = geometry.rotation
    for i in range(len(what)):
        n = solid[i]
        c = code[i]
        along = 1.0
        down = 1.0
        if n < 0:
            positive = d[c, i] < 0
            nx = ny = nz = 0.0
            facing = abs(d[c, i])
            sign = 1.0 if positive else -1.0
            if c == 0:
                nx = sign
                u = p[1, i]
                v = -p[2, i]
            elif c == 1:
                ny = sign
                u = p[0, i]
                v = -p[2, i]
            else:
                nz = sign
                u = p[0, i]
                v = p[1, i]
            m = geometry.room_material[room[i], 2 * c + (0 if positive else 1)]
        else:
            px = p[0, i] - geometry.centre[n, 0]
            py = p[1, i] - geometry.centre[n, 1]
            pz = p[2, i] - geometry.centre[n, 2]
            x = rotation[n, 0, 0] * px + rotation[n, 0, 1] * py + rotation[n, 0, 2] * pz
            y = rotation[n, 1, 0] * px + rotation[n, 1, 1] * py + rotation[n, 1, 2] * pz
            z = rotation[n, 2, 0] * px + rotation[n, 2, 1] * py + rotation[n, 2, 2] * pz
            mx = my = mz = 0.0
            if c == 0:
                mx = 1.0
                u = y
                v = -z
            elif c == 1:
                my = 1.0
                u = x
                v = -z
            elif c == 2:
                mz = 1.0
                u = x
                v = y
            else:
                hx = geometry.half[n, 0]
                hy = geometry.half[n, 1]
                hz = geometry.half[n, 2]
                mx = x / (hx * hx)
                my = y / (hy * hy)
                mz = z / (hz * hz) if c == 3 else 0.0
                scale = 1.0 / np.sqrt(mx * mx + my * my + mz * mz)
                mx *= scale
                my *= scale
                mz *= scale
                # Half turns: two mirrored copies close round the body without a seam.
                u = np.arctan2(y / hy, x / hx) / np.pi
                along = 1.0 / (np.pi * np.sqrt(hx * hy))
                v = -z
                if c == 3:
                    v = np.arccos(min(max(z / hz, -1.0), 1.0)) / np.pi
                    down = 1.0 / (np.pi * hz)
            nx = rotation[n, 0, 0] * mx + rotation[n, 1, 0] * my + rotation[n, 2, 0] * mz
            ny = rotation[n, 0, 1] * mx + rotation[n, 1, 1] * my + rotation[n, 2, 1] * mz
            nz = rotation[n, 0, 2] * mx + rotation[n, 1, 2] * my + rotation[n, 2, 2] * mz
            facing = -(nx * d[0, i] + ny * d[1, i] + nz * d[2, i])
            if facing < 0:
                nx, ny, nz = -nx, -ny, -nz
                facing = -facing
            m = geometry.material[n] if cutter[i] < 0 else geometry.cutter_material[cutter[i]]
        normal[0, i] = nx
        normal[1, i] = ny
        normal[2, i] = nz
        what[i] = m
        # Round coordinates are in turns already: a copy is half a turn, whatever the tile.
        tu = look.tile[m, 0] if along == 1.0 else 1.0
        tv = look.tile[m, 1] if down == 1.0 else 1.0
        place[0, i] = (u - look.offset[m, 0]) / tu
        place[1, i] = (v - look.offset[m, 1]) / tv
        spread[i] = along * down / (tu * tv * max(facing, 1e-3))


@compiled(fastmath=FAST)
def texture_levels(t, pixel, spread, squares, level):
    """Level of resolution at which a texel is as wide as a ray's share of the surface.

    ``pixel`` is the ray's share of the image at z-depth 1; ``squares`` (count,) float32 is scratch.
    """
    factor = (pixel * SIDE) ** 2
    for i in range(len(t)):
        squares[i] = np.float32(max(t[i] * t[i] * spread[i] * factor, 1e-9))
    bits = squares.view(np.int32)
    for i in range(len(t)):
        # A float's exponent is its logarithm's integer part; the mantissa's is near a parabola.
        mantissa = np.float64(bits[i] & 0x7FFFFF) / 8388608.0
        log = np.float64((bits[i] >> 23) - 127) + mantissa * (1.3465 - 0.3465 * mantissa)
        level[i] = min(max(0.5 * log, 0.0), LEVELS - 1.001)


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
            side = SIDE >> (fine + step)
            x = place[0, i] * side - 0.5
            y = place[1, i] * side - 0.5
            left = np.floor(x)
            top = np.floor(y)
            fx = np.float32(x - left)
            fy = np.float32(y - top)
            c0 = _mirrored(np.int64(left), side)
            c1 = _mirrored(np.int64(left) + 1, side)
            r0 = STARTS[fine + step] + side * _mirrored(np.int64(top), side)
            r1 = STARTS[fine + step] + side * _mirrored(np.int64(top) + 1, side)
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
