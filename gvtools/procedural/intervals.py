"""Where rays are inside rooms, solids and cutters: intervals for many rays at once, compiled.

The loops run over rays and have no branches, so that processors do several rays at a time.
"""

from __future__ import annotations

import numpy as np

from gvtools.kernels import FAST, compiled

# Ends of intervals nearer to each other than this share of the way are the same place.
SAME = 1e-9


@compiled(fastmath=FAST)
def box_intervals(low, high, o, d, first, last, near, far, into, out_of):
    """Where rays o + t d, (3, count) each, are inside a box between corners (3,).

    Writes columns ``first`` to ``last`` of ``near`` and ``far`` and the axes at these ends.
    """
    lx, ly, lz = low[0], low[1], low[2]
    hx, hy, hz = high[0], high[1], high[2]
    ox, oy, oz = o[0], o[1], o[2]
    dx, dy, dz = d[0], d[1], d[2]
    for i in range(first, last):
        inverse = 1.0 / dx[i]
        a = (lx - ox[i]) * inverse
        b = (hx - ox[i]) * inverse
        x0 = min(a, b)
        x1 = max(a, b)
        inverse = 1.0 / dy[i]
        a = (ly - oy[i]) * inverse
        b = (hy - oy[i]) * inverse
        y0 = min(a, b)
        y1 = max(a, b)
        inverse = 1.0 / dz[i]
        a = (lz - oz[i]) * inverse
        b = (hz - oz[i]) * inverse
        z0 = min(a, b)
        z1 = max(a, b)
        axis = 0 if x0 > y0 else 1
        start = max(x0, y0)
        into[i] = axis if start > z0 else 2
        near[i] = max(start, z0)
        axis = 0 if x1 < y1 else 1
        end = min(x1, y1)
        out_of[i] = axis if end < z1 else 2
        far[i] = min(end, z1)


@compiled(fastmath=FAST)
def round_intervals(kind, half, o, d, first, last, near, far, into):
    """The same for a ball (kind 1) or a tube (kind 2); ``into`` gets the surface's code."""
    sx = 1.0 / half[0]
    sy = 1.0 / half[1]
    sz = 1.0 / half[2] if kind == 1 else 0.0
    hz = half[2]
    ox, oy, oz = o[0], o[1], o[2]
    dx, dy, dz = d[0], d[1], d[2]
    for i in range(first, last):
        px = ox[i] * sx
        py = oy[i] * sy
        pz = oz[i] * sz
        qx = dx[i] * sx
        qy = dy[i] * sy
        qz = dz[i] * sz
        a = qx * qx + qy * qy + qz * qz
        b = px * qx + py * qy + pz * qz
        c = px * px + py * py + pz * pz - 1.0
        under = b * b - a * c
        root = np.sqrt(max(under, 0.0))
        inverse = 1.0 / a
        near[i] = (-b - root) * inverse if under > 0 else np.inf
        far[i] = (-b + root) * inverse if under > 0 else -np.inf
        into[i] = 3
    if kind == 1:
        return
    for i in range(first, last):
        inverse = 1.0 / dz[i]
        a = (-hz - oz[i]) * inverse
        b = (hz - oz[i]) * inverse
        start = min(a, b)
        into[i] = 2 if start > near[i] else 4
        near[i] = max(near[i], start)
        far[i] = min(far[i], max(a, b))


@compiled(fastmath=FAST)
def leave_rooms(rooms, o, d, count, floats, codes, t, room, code):
    """How far rays that start in a room stay in the union of rooms.

    Writes the ray parameter (0 from a start outside), the room whose wall ends the way (the first
    of several that share the place, so that the answer does not depend on where a ray comes from)
    and the wall's axis. ``floats`` (2 R, count) float64 and ``codes`` (1 + R, count) int64 are
    scratch.
    """
    total = len(rooms)
    for r in range(total):
        box_intervals(
            rooms[r, 0], rooms[r, 1], o, d, 0, count, floats[2 * r], floats[2 * r + 1],
            codes[0], codes[1 + r],
        )  # fmt: skip
    for i in range(count):
        t[i] = 0.0
        room[i] = 0
        code[i] = 0
    moved = 1
    while moved:
        moved = 0
        for r in range(total):
            near = floats[2 * r]
            far = floats[2 * r + 1]
            for i in range(count):
                here = t[i] * (1.0 + SAME)
                on = (near[i] <= here) & (far[i] > here)
                t[i] = far[i] if on else t[i]
                moved += 1 if on else 0
    for back in range(total):
        # Backwards, so that the first of several rooms whose walls coincide remains.
        r = total - 1 - back
        near = floats[2 * r]
        far = floats[2 * r + 1]
        axis = codes[1 + r]
        for i in range(count):
            on = (near[i] < t[i]) & (abs(far[i] - t[i]) <= SAME * t[i])
            room[i] = r if on else room[i]
            code[i] = axis[i] if on else code[i]


@compiled(fastmath=FAST)
def enter_solid(geometry, n, o, d, first, last, best, floats, codes, t, code, cutter):
    """Where rays of a solid's frame first meet what is left of it, if nearer than ``best``.

    Writes columns ``first`` to ``last`` of ``t`` (infinity where it is missed), ``code`` and
    ``cutter`` (-1 for the solid's own surface). ``floats`` (3, count) float64 and ``codes``
    (2, count) int64 are scratch. Returns how many rays meet its hull.
    """
    half = geometry.half[n]
    far = floats[0]
    if geometry.kind[n] == 0:
        box_intervals(-half, half, o, d, first, last, t, far, code, codes[0])
    else:
        round_intervals(geometry.kind[n], half, o, d, first, last, t, far, code)
    met = 0
    for i in range(first, last):
        start = max(t[i], 0.0)
        on = (start < far[i]) & (start < best[i])
        t[i] = start if on else np.inf
        cutter[i] = -1
        met += 1 if on else 0
    if not met:
        return 0
    begin = geometry.first_cutter[n]
    end = geometry.first_cutter[n + 1]
    moved = end - begin
    while moved:
        moved = 0
        for m in range(begin, end):
            box_intervals(
                geometry.cutter[m, 0], geometry.cutter[m, 1], o, d, first, last,
                floats[1], floats[2], codes[0], codes[1],
            )  # fmt: skip
            for i in range(first, last):
                here = t[i] + SAME * far[i]
                on = (t[i] < np.inf) & (floats[1, i] <= here) & (floats[2, i] > here)
                t[i] = floats[2, i] if on else t[i]
                code[i] = codes[1, i] if on else code[i]
                cutter[i] = m if on else cutter[i]
                moved += 1 if on else 0
    if end > begin:
        for i in range(first, last):
            t[i] = np.inf if t[i] >= far[i] * (1.0 - SAME) else t[i]
    return met


@compiled(fastmath=FAST)
def turned(rotation, n, x, first, last, out):
    """(3, count) vectors in the frame of solid n."""
    a, b, c = x[0], x[1], x[2]
    for k in range(3):
        p = rotation[n, k, 0]
        q = rotation[n, k, 1]
        r = rotation[n, k, 2]
        row = out[k]
        for i in range(first, last):
            row[i] = p * a[i] + q * b[i] + r * c[i]
