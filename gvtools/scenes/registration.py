"""Depth of one camera seen by another: forward warping with footprints and a z-buffer.

Each depth pixel is a small surface that covers its whole pixel square. Neighbours on the same
surface share their corners, so that a smooth surface stays closed however it is stretched; at a
depth edge every pixel keeps its own square, so that a silhouette does not grow.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

# Neighbouring depths that differ by less than this share a surface (relative to the nearer).
SAME_SURFACE = 0.05
# A footprint wider than this in the target (pixels) is a degenerate projection beside the camera.
WIDEST_FOOTPRINT = 64.0


def register_depth(
    depth: ArrayLike,
    depth_K: ArrayLike,
    color_K: ArrayLike,
    *,
    color_from_depth: ArrayLike,
    width: int,
    height: int,
) -> NDArray[np.float32]:
    """(height, width) float32 z-depth as the colour camera would have measured it, 0 for none.

    Intrinsics are (3, 3), pixels, first pixel centre (0.5, 0.5); ``color_from_depth`` is (4, 4)
    rigid in scene units. A pixel has depth where a surface falls on its centre.
    """
    z = np.ascontiguousarray(depth, np.float32)
    K_depth, K_color = np.asarray(depth_K, np.float64), np.asarray(color_K, np.float64)
    transform = np.asarray(color_from_depth, np.float64)
    # homogeneous colour pixel = z * A @ (u, v, 1) + b
    A = K_color @ transform[:3, :3] @ np.linalg.inv(K_depth)
    b = K_color @ transform[:3, 3]
    inverse = np.zeros((height, width), np.float32)
    _warp(z, A, b, inverse)
    return np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)


@njit(cache=True)
def _corner(inverse_z, v, u, dv, du):  # type: ignore[no-untyped-def]
    """Inverse depth at one corner of pixel (v, u): the mean over neighbours on its surface."""
    height, width = inverse_z.shape
    own = inverse_z[v, u]
    total, count = own, 1
    for y, x in ((v + dv, u), (v, u + du), (v + dv, u + du)):
        if 0 <= y < height and 0 <= x < width:
            other = inverse_z[y, x]
            if other > 0 and abs(other - own) <= SAME_SURFACE * min(own, other):
                total += other
                count += 1
    return total / count


@njit(cache=True)
def _triangle(px, py, pw, i, j, k, image):  # type: ignore[no-untyped-def]
    """Rasterise one triangle of inverse depth; the nearest surface wins."""
    height, width = image.shape
    area = (px[j] - px[i]) * (py[k] - py[i]) - (px[k] - px[i]) * (py[j] - py[i])
    if area == 0.0:
        return
    left = max(0, int(np.ceil(min(px[i], px[j], px[k]) - 0.5)))
    right = min(width - 1, int(np.floor(max(px[i], px[j], px[k]) - 0.5)))
    top = max(0, int(np.ceil(min(py[i], py[j], py[k]) - 0.5)))
    bottom = min(height - 1, int(np.floor(max(py[i], py[j], py[k]) - 0.5)))
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            cx, cy = x + 0.5, y + 0.5
            a = ((px[j] - cx) * (py[k] - cy) - (px[k] - cx) * (py[j] - cy)) / area
            b = ((px[k] - cx) * (py[i] - cy) - (px[i] - cx) * (py[k] - cy)) / area
            c = 1.0 - a - b
            # A shared edge may be drawn twice, never missed: the z-buffer settles doubles.
            if a >= -1e-9 and b >= -1e-9 and c >= -1e-9:
                value = a * pw[i] + b * pw[j] + c * pw[k]
                if value > image[y, x]:
                    image[y, x] = value


@njit(cache=True)
def _warp(z, A, b, image):  # type: ignore[no-untyped-def]
    """Draw every pixel's square, as two triangles, into ``image`` of inverse colour depth."""
    height, width = z.shape
    inverse_z = np.zeros((height, width))
    for v in range(height):
        for u in range(width):
            if z[v, u] > 0:
                inverse_z[v, u] = 1.0 / z[v, u]
    px, py, pw = np.empty(4), np.empty(4), np.empty(4)
    for v in range(height):
        for u in range(width):
            if inverse_z[v, u] <= 0:
                continue
            ahead = True
            for n in range(4):
                dv, du = 2 * (n // 2) - 1, 2 * (n % 2) - 1
                depth = 1.0 / _corner(inverse_z, v, u, dv, du)
                x, y = u + (du + 1) // 2, v + (dv + 1) // 2
                w = depth * (A[2, 0] * x + A[2, 1] * y + A[2, 2]) + b[2]
                if w <= 0:
                    ahead = False
                    break
                px[n] = (depth * (A[0, 0] * x + A[0, 1] * y + A[0, 2]) + b[0]) / w
                py[n] = (depth * (A[1, 0] * x + A[1, 1] * y + A[1, 2]) + b[1]) / w
                pw[n] = 1.0 / w
            if not ahead or max(px) - min(px) > WIDEST_FOOTPRINT:
                continue
            if max(py) - min(py) > WIDEST_FOOTPRINT:
                continue
            _triangle(px, py, pw, 0, 1, 3, image)
            _triangle(px, py, pw, 0, 3, 2, image)
