"""Depth maps tidied along the edges of the picture; nothing is made up where depth is unknown."""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gvtools.kernels import compiled

Float32 = NDArray[np.float32]

# How fast the weight of a neighbour falls with the difference in luminance.
LUMINANCE = 0.06


def without_speckles(depth: Float32, step: float, smallest: int) -> Float32:
    """Depth without patches smaller than ``smallest`` pixels.

    Args:
        depth: (H, W) float32, 0 = unknown.
        step: relative difference up to which neighbours (above, below, beside) belong together.
        smallest: pixels.

    Returns:
        (H, W) float32.
    """
    cell = np.arange(depth.size).reshape(depth.shape)
    first, second = [], []
    for here, there in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        nearer = np.minimum(depth[here], depth[there])
        joined = (nearer > 0) & (np.abs(depth[here] - depth[there]) <= step * nearer)
        first.append(cell[here][joined])
        second.append(cell[there][joined])
    rows, columns = np.concatenate(first), np.concatenate(second)
    edges = coo_array((np.ones(len(rows), bool), (rows, columns)), (depth.size, depth.size))
    _, patch = connected_components(edges, directed=False)
    size = np.bincount(patch)[patch].reshape(depth.shape)
    return np.where(size >= smallest, depth, np.float32(0))


@compiled(parallel=True)
def weighted_median(depth: Float32, guide: Float32, weight: Float32, radius: int) -> Float32:
    """The weighted median of known depths round each known pixel.

    Args:
        depth: (H, W) float32, 0 = unknown; stays unknown.
        guide: (H, W) float32 luminance; neighbours of another luminance count less.
        weight: (H, W) float32, how much each pixel's depth is trusted.
        radius: pixels; every other pixel of the square is looked at.

    Returns:
        (H, W) float32.
    """
    height, width = depth.shape
    result = np.zeros_like(depth)
    most = (2 * radius + 1) ** 2
    for y in prange(height):
        value, trust = np.empty(most, np.float32), np.empty(most, np.float32)
        for x in range(width):
            if not depth[y, x] > 0:
                continue
            count, total = 0, np.float32(0)
            for dy in range(-radius, radius + 1):
                ny = y + dy
                if ny < 0 or ny >= height:
                    continue
                for dx in range(-radius, radius + 1):
                    nx = x + dx
                    if (dx + dy) % 2 != 0 or nx < 0 or nx >= width or not depth[ny, nx] > 0:
                        continue
                    apart = abs(guide[ny, nx] - guide[y, x]) / np.float32(LUMINANCE)
                    w = weight[ny, nx] * np.exp(-apart)
                    # Kept in order as they come: few values, nearly sorted.
                    at = count
                    while at > 0 and value[at - 1] > depth[ny, nx]:
                        value[at], trust[at] = value[at - 1], trust[at - 1]
                        at -= 1
                    value[at], trust[at] = depth[ny, nx], w
                    count += 1
                    total += w
            half, i = total / 2, 0
            before = trust[0]
            while before < half and i < count - 1:
                i += 1
                before += trust[i]
            result[y, x] = value[i]
    return result


@compiled(parallel=True)
def enlarged(
    depth: Float32, guide: Float32, fine_guide: Float32, trust: Float32
) -> tuple[Float32, Float32]:
    """A depth map at the size of a larger picture, its edges where the picture's are.

    Among the four depths round a pixel, those that lie near the most alike one are averaged, by
    nearness and likeness; a pixel whose nearest depth is unknown stays unknown.

    Args:
        depth: (h, w) float32, 0 = unknown.
        guide: (h, w) float32 luminance of the small picture.
        fine_guide: (H, W) float32 luminance of the large one.
        trust: (h, w) float32, interpolated along.

    Returns:
        (H, W) float32 depth and (H, W) float32 trust.
    """
    height, width = fine_guide.shape
    h, w = depth.shape
    result, passed = np.zeros((height, width), np.float32), np.ones((height, width), np.float32)
    for y in prange(height):
        cy = (y + 0.5) * h / height - 0.5
        y0 = int(np.floor(cy))
        for x in range(width):
            cx = (x + 0.5) * w / width - 0.5
            x0 = int(np.floor(cx))
            nearest_y = min(max(int(np.floor(cy + 0.5)), 0), h - 1)
            nearest_x = min(max(int(np.floor(cx + 0.5)), 0), w - 1)
            if not depth[nearest_y, nearest_x] > 0:
                continue
            chosen, best = np.float32(0), -1.0
            for j in range(2):
                for i in range(2):
                    sy, sx = min(max(y0 + j, 0), h - 1), min(max(x0 + i, 0), w - 1)
                    like = np.exp(-abs(guide[sy, sx] - fine_guide[y, x]) / LUMINANCE)
                    near = (1 - abs(y0 + j - cy)) * (1 - abs(x0 + i - cx))
                    if depth[sy, sx] > 0 and like * near > best:
                        best, chosen = like * near, depth[sy, sx]
            total, mean, sure = 1e-12, chosen * 1e-12, 0.0
            for j in range(2):
                for i in range(2):
                    sy, sx = min(max(y0 + j, 0), h - 1), min(max(x0 + i, 0), w - 1)
                    if depth[sy, sx] > 0 and abs(depth[sy, sx] / chosen - 1) < 0.05:
                        near = (1 - abs(y0 + j - cy)) * (1 - abs(x0 + i - cx))
                        total += near
                        mean += near * depth[sy, sx]
                        sure += near * trust[sy, sx]
            result[y, x] = mean / total
            passed[y, x] = sure / total
    return result, passed
