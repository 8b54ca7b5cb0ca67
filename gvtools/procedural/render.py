"""Pictures and exact depth of procedural scenes by ray casting, compiled and parallel over rows.

A pixel's colour is the mean of 2 x 2 rays, in linear light; its depth is that of the one ray
through its centre, so that it is a surface's and not a mean of two.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.kernels import FAST, compiled
from gvtools.procedural.color import encode_srgb
from gvtools.procedural.geometry import Geometry
from gvtools.procedural.light import light_on
from gvtools.procedural.ray_cast import CODES, FLOATS, cast, rectangles, trace_row, world_rays
from gvtools.procedural.shading import Look, add_colors, surface_places, texture_levels

Float32 = NDArray[np.float32]

SUPERSAMPLE = 2
# The tone curve's table: this many steps of linear light from 0 to BRIGHTEST.
STEPS = 8192
BRIGHTEST = 4.0


def radiance(
    geometry: Geometry, look: Look, cameras: Cameras, *, supersample: int = SUPERSAMPLE
) -> tuple[Float32, Float32]:
    """Linear light and depth that cameras of one size see.

    Args:
        geometry: of the scene.
        look: of the scene.
        cameras: V of them.
        supersample: rays along a pixel's side, for the colour.

    Returns:
        (V, H, W, 3) and (V, H, W) float32.
    """
    shape = (len(cameras), int(cameras.height[0]), int(cameras.width[0]))
    color = np.empty((*shape, 3), np.float32)
    focal = np.sqrt(cameras.K[:, 0, 0] * cameras.K[:, 1, 1])
    _render_rows(
        geometry, look, world_rays(cameras), cameras.centers, rectangles(geometry, cameras), focal,
        supersample, color,
    )  # fmt: skip
    return color, cast(geometry, cameras).depth.astype(np.float32)


def developed(light: Float32, exposure: float) -> NDArray[np.uint8]:
    """(..., 3) linear light to 8-bit sRGB by the tone curve of ``color.encode_srgb``."""
    out = np.empty(light.shape, np.uint8)
    _develop(light.reshape(-1), np.float32(exposure * (STEPS - 1) / BRIGHTEST), _TONES, out.ravel())
    return out


_TONES = encode_srgb(np.linspace(0, BRIGHTEST, STEPS, dtype=np.float32))


@compiled(parallel=True)
def _render_rows(geometry, look, rays, centers, rects, focal, supersample, color):
    views, height = color.shape[:2]
    for job in prange(views * height):
        v = job // height
        row = job % height
        color[v, row] = np.float32(0)
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
def _develop(light, factor, tones, out):
    top = len(tones) - 1
    for i in range(len(light)):
        out[i] = tones[min(int(light[i] * factor + np.float32(0.5)), top)]
