"""Ray casting of procedural geometry: exact first intersections, compiled.

Free space is the union of axis-aligned boxes ("rooms") less the solids; a solid is a turned box,
ellipsoid or elliptic cylinder less boxes in its own frame ("cutters"). A ray's way through it is a
matter of intervals, so every intersection is exact, doorways, niches and shelves included. Loops
run over rays and have no branches, so that processors do several rays at a time; rays go by image
rows, and solids that cannot show in a row, or in a part of it, are left out there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64
from gvtools.kernels import FAST, compiled, in_threads

Int64 = NDArray[np.int64]

BOX, BALL, TUBE = 0, 1, 2
# Codes of the surface that a ray meets beside 0, 1, 2: flat, across that local axis.
ROUND, SIDE = 3, 4


class RoomGeometry(NamedTuple):
    """What rays meet. World frame: z up, metres."""

    rooms: Float64  # (R, 2, 3) lowest and highest corner of each room
    room_material: Int64  # (R, 6) of the walls -x, +x, -y, +y, of the floor and of the ceiling
    kind: Int64  # (N,) BOX, BALL or TUBE (along its z axis)
    rotation: Float64  # (N, 3, 3) local_from_world
    centre: Float64  # (N, 3)
    half: Float64  # (N, 3) half extents along the local axes
    material: Int64  # (N,)
    shades: NDArray[np.bool_]  # (N,) bool, whether it keeps a lamp's light away
    first_cutter: Int64  # (N + 1,) where each solid's cutters start
    cutter: Float64  # (M, 2, 3) lowest and highest corner, frame of their solid
    cutter_material: Int64  # (M,) of the surfaces that cutting makes


def clearance(geometry: RoomGeometry, points: Float64) -> Float64:
    """(P,) distance of points to the nearest wall or solid's hull, negative inside or outside.

    In a room of several boxes, the distance to the walls is that of the best box: never too large.
    """
    place = points[:, None]
    to_walls = np.minimum(place - geometry.rooms[:, 0], geometry.rooms[:, 1] - place).min(2)
    local = np.einsum("nij,pnj->pni", geometry.rotation, place - geometry.centre)
    over = np.abs(local) - geometry.half
    outside = np.linalg.norm(np.maximum(over, 0), axis=2)
    to_hulls = np.where(outside > 0, outside, over.max(2))
    return np.minimum(to_walls.max(1), to_hulls.min(1, initial=np.inf))


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
    start = np.int64(0)
    for r in range(total):
        box_intervals(
            rooms[r, 0], rooms[r, 1], o, d, start, count, floats[2 * r], floats[2 * r + 1],
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


NEAR = 1e-3  # corners of a hull nearer than this give no image rectangle, metres
# Rows of scratch that a line of rays needs beside two for each room.
FLOATS, CODES = 10, 4


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What the rays through pixel centres of V views meet."""

    depth: Float64  # (V, H, W) float64 z-depth, metres; 0 for a camera that stands in no room
    solid: Int64  # (V, H, W) int64, -1 for a wall


def cast(geometry: RoomGeometry, cameras: Cameras) -> Surfaces:
    """The surfaces at the pixel centres of cameras of one size."""
    shape = (len(cameras), int(cameras.height[0]), int(cameras.width[0]))
    out = Surfaces(np.empty(shape), np.empty(shape, np.int64))
    in_threads(
        _cast_rows, shape[0] * shape[1], geometry, world_rays(cameras), cameras.centers,
        rectangles(geometry, cameras), 1, out.depth, out.solid,
    )  # fmt: skip
    return out


def world_rays(cameras: Cameras) -> Float64:
    """(V, 3, 3): pixel coordinates (x, y, 1) to world directions of z-depth 1."""
    return np.swapaxes(cameras.cam_from_world[:, :3, :3], 1, 2) @ np.linalg.inv(cameras.K)


def rectangles(geometry: RoomGeometry, cameras: Cameras) -> Int64:
    """(V, N, 4) first and last row, first and last column that each solid's hull can cover."""
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(8, 3)
    corners = (geometry.half[:, None] * signs) @ geometry.rotation + geometry.centre[:, None]
    local = np.einsum("vij,nkj->vnki", cameras.cam_from_world[:, :3, :3], corners)
    local += cameras.cam_from_world[:, None, None, :3, 3]
    xy = np.einsum("vij,vnkj->vnki", cameras.K[:, :2], local)
    z = local[..., 2]
    xy /= np.maximum(z, NEAR)[..., None]
    limit = np.array([int(cameras.width[0]), int(cameras.height[0])])
    first = np.clip(np.floor(xy.min(2)) - 1, 0, limit)
    last = np.clip(np.ceil(xy.max(2)), -1, limit - 1)
    around = z.min(2) < NEAR
    first[around], last[around] = 0, limit - 1
    last[z.max(2) < NEAR] = -1
    rect = np.stack([first[..., 1], last[..., 1], first[..., 0], last[..., 0]], -1)
    return np.ascontiguousarray(rect.astype(np.int64))


@compiled(fastmath=FAST)
def trace_row(
    geometry, view, rays, centers, rects, row, y, samples, o, d, local, floats, codes,
    t, room, solid, code, cutter,
):  # fmt: skip
    """Follow the rays of one line across an image row.

    ``y`` is the line's coordinate; there are ``samples`` rays to a pixel along it, ``count`` in
    all. ``o`` and ``d`` (3, count) return their origins and directions; ``local`` (6, count),
    ``floats`` (FLOATS + 2 R, count) and ``codes`` (CODES + R, count) are scratch. Results go to
    ``t``, ``room``, ``solid``, ``code`` and ``cutter``, (count,) each.
    """
    count = len(t)
    for k in range(3):
        step = rays[view, k, 0] / samples
        base = rays[view, k, 1] * y + rays[view, k, 2] + 0.5 * step
        for i in range(count):
            d[k, i] = base + step * i
            o[k, i] = centers[view, k]
    leave_rooms(geometry.rooms, o, d, count, floats, codes, t, room, code)
    for i in range(count):
        solid[i] = -1
        cutter[i] = -1
    at = floats[3]
    surface = codes[2]
    made = codes[3]
    for n in range(len(geometry.kind)):
        first = rects[view, n, 2] * samples
        last = (rects[view, n, 3] + 1) * samples
        if row < rects[view, n, 0] or row > rects[view, n, 1] or first >= last:
            continue
        plain = geometry.kind[n] == 0 and geometry.first_cutter[n] == geometry.first_cutter[n + 1]
        if plain:
            _enter_plain_box(
                geometry, n, view, rays, centers, y, samples, first, last, t, solid, code, cutter
            )
            continue
        turned(geometry.rotation, n, d, first, last, local[3:])
        for k in range(3):
            away = _away(geometry, n, k, view, centers)
            for i in range(first, last):
                local[k, i] = away
        if not enter_solid(
            geometry, n, local[:3], local[3:], first, last, t, floats, codes, at, surface, made
        ):
            continue
        for i in range(first, last):
            on = at[i] < t[i]
            t[i] = at[i] if on else t[i]
            solid[i] = n if on else solid[i]
            code[i] = surface[i] if on else code[i]
            cutter[i] = made[i] if on else cutter[i]


@compiled(inline="always")
def _away(geometry, n, k, view, centers):
    """Component k of the camera's place in the frame of solid n."""
    total = 0.0
    for j in range(3):
        total += geometry.rotation[n, k, j] * (centers[view, j] - geometry.centre[n, j])
    return total


@compiled(inline="always")
def _along(geometry, n, k, view, rays, y, samples):
    """Step from ray to ray and start of directions' component k in the frame of solid n."""
    step = 0.0
    base = 0.0
    for j in range(3):
        turn = geometry.rotation[n, k, j]
        step += turn * rays[view, j, 0] / samples
        base += turn * (rays[view, j, 1] * y + rays[view, j, 2])
    return step, base + 0.5 * step


@compiled(fastmath=FAST)
def _enter_plain_box(
    geometry, n, view, rays, centers, y, samples, first, last, t, solid, code, cutter
):  # fmt: skip
    """``enter_solid`` for what most solids are, a box without cutters: one loop, less memory.

    Along a line of rays a direction's components rise evenly, in the box's frame as well.
    """
    sx, bx = _along(geometry, n, 0, view, rays, y, samples)
    sy, by = _along(geometry, n, 1, view, rays, y, samples)
    sz, bz = _along(geometry, n, 2, view, rays, y, samples)
    ox = _away(geometry, n, 0, view, centers)
    oy = _away(geometry, n, 1, view, centers)
    oz = _away(geometry, n, 2, view, centers)
    hx = geometry.half[n, 0]
    hy = geometry.half[n, 1]
    hz = geometry.half[n, 2]
    for i in range(first, last):
        inverse = 1.0 / (sx * i + bx)
        a = (-hx - ox) * inverse
        b = (hx - ox) * inverse
        near = min(a, b)
        far = max(a, b)
        inverse = 1.0 / (sy * i + by)
        a = (-hy - oy) * inverse
        b = (hy - oy) * inverse
        into = 0 if near > min(a, b) else 1
        near = max(near, min(a, b))
        far = min(far, max(a, b))
        inverse = 1.0 / (sz * i + bz)
        a = (-hz - oz) * inverse
        b = (hz - oz) * inverse
        into = into if near > min(a, b) else 2
        near = max(near, min(a, b))
        far = min(far, max(a, b))
        near = max(near, 0.0)
        on = (near < far) & (near < t[i])
        t[i] = near if on else t[i]
        solid[i] = n if on else solid[i]
        code[i] = into if on else code[i]
        cutter[i] = -1 if on else cutter[i]


@compiled()
def _cast_rows(first, last, geometry, rays, centers, rects, samples, depth, solid):
    _, height, width = depth.shape
    total = len(geometry.rooms)
    for job in range(first, last):
        v = job // height
        row = job % height
        ends = np.empty((6, width))
        local = np.empty((6, width))
        floats = np.empty((FLOATS + 2 * total, width))
        codes = np.empty((CODES + total, width), np.int64)
        hits = np.empty((3, width), np.int64)
        trace_row(
            geometry, v, rays, centers, rects, row, row + 0.5, samples, ends[:3], ends[3:], local,
            floats, codes, depth[v, row], hits[0], solid[v, row], hits[1], hits[2],
        )  # fmt: skip
