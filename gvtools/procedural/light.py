"""Light on the surfaces of a procedural scene: from above and below, from afar, and from lamps."""

from __future__ import annotations

import numpy as np

from gvtools.kernels import FAST, compiled
from gvtools.procedural.intervals import SAME, enter_solid, leave_rooms, turned

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
