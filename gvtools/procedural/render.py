"""Pictures and exact depth of procedural scenes by ray casting, compiled and parallel over rows.

A pixel's colour is the mean of 2 x 2 rays, in linear light; its depth is that of the one ray
through its centre, so that it is a surface's and not a mean of two.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64
from gvtools.kernels import FAST, compiled, in_threads
from gvtools.procedural.ray_cast import (
    CODES,
    FLOATS,
    SAME,
    RoomGeometry,
    cast,
    enter_solid,
    leave_rooms,
    rectangles,
    trace_row,
    turned,
    world_rays,
)

Float32 = NDArray[np.float32]


def decode_srgb(encoded: NDArray[np.uint8]) -> Float32:
    """Linear light in [0, 1] of 8-bit sRGB."""
    value = np.arange(256) / 255
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[encoded]


def encode_srgb(linear: Float32) -> NDArray[np.uint8]:
    """8-bit sRGB of linear light; the brightest tenth is rolled off instead of cut."""
    knee = np.float32(0.7)
    over = np.maximum(linear - knee, 0)
    value = np.minimum(linear, knee) + (1 - knee) * (1 - np.exp(-over / (1 - knee)))
    value = np.clip(value, 0, 1)
    value = np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.rint(value * 255).astype(np.uint8)


Int64 = NDArray[np.int64]


class Look(NamedTuple):
    """Materials and light. Colours are linear light."""

    texture: Int64  # (P,) row of ``texels``
    tile: Float64  # (P, 2) length that one copy of the texture covers, metres
    offset: Float64  # (P, 2) of the texture's corner, metres
    gain: Float64  # (P, 3) factor on the texture
    emission: Float64  # (P,) light of the surface's own, for what lies outside windows
    texels: Float32  # (T, texels, 3) float32, see ``textures.stacked``
    starts: Int64  # (levels + 1,), see ``textures.level_starts``
    side: int  # texels along a side of the finest level
    ambient: Float64  # (2, 3) light from above and from below
    sun: Float64  # (2, 3) direction towards it (unit length), and its light
    # (L, 2, 3) position, and its light on a surface that faces it from half its reach
    lamps: Float64
    reach: float  # metres; a lamp's light falls off as 1 / (1 + (distance / reach)²)
    shadows: bool  # whether solids and walls keep the lamps' light away


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


# A surface point is lifted by this share of its way to the lamp, or it would shade itself.
LIFT = 1e-6


@compiled(fastmath=FAST)
def light_on(geometry, look, p, normal, light, o, d, local, floats, codes):
    """Light (3, count) on surface points ``p`` with normals.

    ``o``, ``d`` (3, count), ``local`` (6, count), ``floats`` (4 + 2 R, count) and ``codes``
    (4 + R, count) are scratch.
    """
    count = p.shape[1]
    for k in range(3):
        above = look.ambient[0, k]
        below = look.ambient[1, k]
        sun = look.sun[1, k]
        for i in range(count):
            up = 0.5 + 0.5 * normal[2, i]
            facing = look.sun[0, 0] * normal[0, i] + look.sun[0, 1] * normal[1, i]
            facing += look.sun[0, 2] * normal[2, i]
            light[k, i] = below + (above - below) * up + sun * max(facing, 0.0)
    way = floats[len(floats) - 1]
    for lamp in look.lamps:
        if lamp[1, 1] <= 0:
            continue
        for i in range(count):
            way[i] = 1.0
        if look.shadows:
            _ways_to_lamp(geometry, lamp, p, normal, way, o, d, local, floats, codes)
        _add_lamp(lamp, look.reach, p, normal, way, light)


@compiled(fastmath=FAST)
def _add_lamp(lamp, reach, p, normal, way, light):
    """Add a lamp's light where nothing stands on the way."""
    falloff = 1.0 / (reach * reach)
    for i in range(len(way)):
        x = lamp[0, 0] - p[0, i]
        y = lamp[0, 1] - p[1, i]
        z = lamp[0, 2] - p[2, i]
        squared = x * x + y * y + z * z
        facing = x * normal[0, i] + y * normal[1, i] + z * normal[2, i]
        strength = max(facing, 0.0) / np.sqrt(squared + 1e-12) * 1.25 / (1.0 + squared * falloff)
        strength = strength if way[i] >= 1.0 else 0.0
        light[0, i] += strength * lamp[1, 0]
        light[1, i] += strength * lamp[1, 1]
        light[2, i] += strength * lamp[1, 2]


@compiled(fastmath=FAST)
def _ways_to_lamp(geometry, lamp, p, normal, way, o, d, local, floats, codes):
    """Write where on each point's way to the lamp, 0 to 1, something stands; 1 for nothing."""
    count = p.shape[1]
    for k in range(3):
        for i in range(count):
            to = lamp[0, k] - p[k, i]
            o[k, i] = p[k, i] + LIFT * (normal[k, i] + to)
            d[k, i] = lamp[0, k] - o[k, i]
    if len(geometry.rooms) > 1:
        spare = len(codes) - 2
        leave_rooms(geometry.rooms, o, d, count, floats, codes, way, codes[spare], codes[spare + 1])
        for i in range(count):
            way[i] = min(way[i] + SAME, 1.0)
    for n in range(len(geometry.kind)):
        if not geometry.shades[n]:
            continue
        first, last = _near_the_way(geometry, n, o, d)
        if first >= last:
            continue
        for k in range(3):
            for i in range(first, last):
                local[3 + k, i] = o[k, i] - geometry.centre[n, k]
        turned(geometry.rotation, n, local[3:], first, last, local[:3])
        turned(geometry.rotation, n, d, first, last, local[3:])
        at = floats[3]
        enter_solid(
            geometry, n, local[:3], local[3:], first, last, way, floats, codes, at, codes[2],
            codes[3],
        )  # fmt: skip
        for i in range(first, last):
            way[i] = min(way[i], at[i])


@compiled(fastmath=FAST)
def _near_the_way(geometry, n, o, d):
    """First and last ray that comes into the sphere round a solid's hull; most come into none."""
    cx = geometry.centre[n, 0]
    cy = geometry.centre[n, 1]
    cz = geometry.centre[n, 2]
    reach = geometry.half[n, 0] ** 2 + geometry.half[n, 1] ** 2 + geometry.half[n, 2] ** 2
    ox, oy, oz = o[0], o[1], o[2]
    dx, dy, dz = d[0], d[1], d[2]
    count = len(ox)
    first = count
    last = 0
    for i in range(count):
        x = ox[i] - cx
        y = oy[i] - cy
        z = oz[i] - cz
        along = -(x * dx[i] + y * dy[i] + z * dz[i])
        along /= dx[i] * dx[i] + dy[i] * dy[i] + dz[i] * dz[i]
        along = min(max(along, 0.0), 1.0)
        x += along * dx[i]
        y += along * dy[i]
        z += along * dz[i]
        near = x * x + y * y + z * z <= reach
        first = min(first, i if near else count)
        last = max(last, i + 1 if near else 0)
    return first, last


SUPERSAMPLE = 2
# The tone curve's table: this many steps of linear light from 0 to BRIGHTEST.
STEPS = 8192
BRIGHTEST = 4.0


def radiance(
    geometry: RoomGeometry, look: Look, cameras: Cameras, *, supersample: int = SUPERSAMPLE
) -> tuple[Float32, Float32]:
    """Linear light and depth that cameras of one size see.

    Returns:
        (V, H, W, 3) and (V, H, W) float32.
    """
    shape = (len(cameras), int(cameras.height[0]), int(cameras.width[0]))
    color = np.zeros((*shape, 3), np.float32)
    focal = np.sqrt(cameras.K[:, 0, 0] * cameras.K[:, 1, 1])
    in_threads(
        _render_rows, shape[0] * shape[1], geometry, look, world_rays(cameras), cameras.centers,
        rectangles(geometry, cameras), focal, supersample, color,
    )  # fmt: skip
    return color, cast(geometry, cameras).depth.astype(np.float32)


def to_srgb(light: Float32, exposure: float) -> NDArray[np.uint8]:
    """(..., 3) linear light to 8-bit sRGB by the tone curve of ``color.encode_srgb``."""
    out = np.empty(light.shape, np.uint8)
    develop(light.reshape(-1), np.float32(exposure * (STEPS - 1) / BRIGHTEST), _TONES, out.ravel())
    return out


_TONES = encode_srgb(np.linspace(0, BRIGHTEST, STEPS, dtype=np.float32))


@compiled()
def _render_rows(first, last, geometry, look, rays, centers, rects, focal, supersample, color):
    height = color.shape[1]
    for job in range(first, last):
        v = job // height
        row = job % height
        _color_row(
            geometry, look, v, rays, centers, rects, row, supersample,
            1.0 / (supersample * focal[v]), color[v, row],
        )  # fmt: skip


@compiled(fastmath=FAST)
def _color_row(geometry, look, view, rays, centers, rects, row, supersample, pixel, color):
    """Add up the rays of a row's pixels; ``pixel`` is the width of one ray's share at z-depth 1."""
    count = len(color) * supersample
    total = len(geometry.rooms)
    ends = np.empty((6, count))
    points = np.empty((9, count))
    local = np.empty((6, count))
    floats = np.empty((FLOATS + 2 * total, count))
    codes = np.empty((CODES + total, count), np.int64)
    hits = np.empty((5, count), np.int64)
    t = np.empty(count)
    squares = np.empty(count, np.float32)
    for line in range(supersample):
        y = row + (line + 0.5) / supersample
        trace_row(
            geometry, view, rays, centers, rects, row, y, supersample, ends[:3], ends[3:], local,
            floats, codes, t, hits[0], hits[1], hits[2], hits[3],
        )  # fmt: skip
        for k in range(3):
            for i in range(count):
                points[k, i] = centers[view, k] + t[i] * ends[3 + k, i]
        # Places and levels outlive the light, which needs the other scratch.
        place = points[6:8]
        level = points[8]
        surface_places(
            geometry, look, ends[3:], points[:3], hits[0], hits[1], hits[2], hits[3], points[3:6],
            hits[4], place, level,
        )  # fmt: skip
        texture_levels(look, t, pixel, level, squares, level)
        light = floats[4 + 2 * total : 7 + 2 * total]
        light_on(
            geometry, look, points[:3], points[3:6], light, ends[:3], ends[3:], local, floats,
            codes,
        )  # fmt: skip
        add_colors(look, hits[4], place, level, light, supersample, color)
    share = np.float32(1.0 / (supersample * supersample))
    for col in range(len(color)):
        for k in range(3):
            color[col, k] *= share


@compiled()
def develop(light, factor, tones, out):
    """Look light (N,) times ``factor`` up in the tone curve's table."""
    top = len(tones) - 1
    for i in range(len(light)):
        out[i] = tones[min(int(light[i] * factor + np.float32(0.5)), top)]
