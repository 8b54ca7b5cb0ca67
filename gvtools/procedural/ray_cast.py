"""Which surfaces of a procedural scene the rays of a camera meet first: exact, compiled.

Rays go by image rows; solids that cannot show in a row, or in a part of it, are left out there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.kernels import FAST, compiled
from gvtools.procedural.geometry import Geometry
from gvtools.procedural.intervals import enter_solid, leave_rooms, turned

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NEAR = 1e-3  # corners of a hull nearer than this give no image rectangle, metres
# Rows of scratch that a line of rays needs beside two for each room.
FLOATS, CODES = 10, 4


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What the rays through pixel centres of V views meet.

    Attributes:
        depth: (V, H, W) float64 z-depth, metres; 0 for a camera that stands in no room.
        solid: (V, H, W) int64, -1 for a wall.
    """

    depth: Float64
    solid: Int64


def cast(geometry: Geometry, cameras: Cameras) -> Surfaces:
    """The surfaces at the pixel centres of cameras of one size."""
    shape = (len(cameras), int(cameras.height[0]), int(cameras.width[0]))
    out = Surfaces(np.empty(shape), np.empty(shape, np.int64))
    _cast_rows(
        geometry, world_rays(cameras), cameras.centers, rectangles(geometry, cameras),
        out.depth, out.solid,
    )  # fmt: skip
    return out


def world_rays(cameras: Cameras) -> Float64:
    """(V, 3, 3): pixel coordinates (x, y, 1) to world directions of z-depth 1."""
    return np.swapaxes(cameras.cam_from_world[:, :3, :3], 1, 2) @ np.linalg.inv(cameras.K)


def rectangles(geometry: Geometry, cameras: Cameras) -> Int64:
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


@compiled(parallel=True)
def _cast_rows(geometry, rays, centers, rects, depth, solid):
    views, height, width = depth.shape
    total = len(geometry.rooms)
    for job in prange(views * height):
        v = job // height
        row = job % height
        ends = np.empty((6, width))
        local = np.empty((6, width))
        floats = np.empty((FLOATS + 2 * total, width))
        codes = np.empty((CODES + total, width), np.int64)
        hits = np.empty((3, width), np.int64)
        trace_row(
            geometry, v, rays, centers, rects, row, row + 0.5, 1, ends[:3], ends[3:], local,
            floats, codes, depth[v, row], hits[0], solid[v, row], hits[1], hits[2],
        )  # fmt: skip
