"""Depth maps filtered: agreement of views, confidence, speckles, and the picture's silhouettes.

A window that straddles the outline of a roof matches by the roof even where its centre lies in the
sky, in every view alike, so depth grows past outlines by half a window and consistency confirms it.
Such a rim is thin, looks like the unknown beyond it and unlike the surface that it hangs on. It is
taken back from the outside (``trim_outlines``). What that takes from the borders of real surfaces
grows again from what remains, wherever depth and colour run on (``regrow``); across an outline
colour does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gvtools.cameras import Cameras
from gvtools.depth.stereo.geometry import relative_warps
from gvtools.depth.stereo.matching import pixel_centers
from gvtools.kernels import compiled

Float32 = NDArray[np.float32]

# How fast the weight of a neighbour falls with the difference in luminance.
LUMINANCE = 0.06
Bytes = NDArray[np.uint8]

# How fast a neighbour's vote falls with its difference in colour (the largest of the channels), and
# up to which difference depth runs on; a share of the whole range.
ALIKE, SAME = 0.06, 0.03
# Rounds of trimming at most; a rim of half a window is gone after as many as it has pixels.
ROUNDS = 8
# Weight of a confirming view's depth over the view's own, when they are averaged.
OTHERS = 1.0
# A depth counts as right when its relative error is below this.
RIGHT = 0.05
# Logistic regression of "right" on the features in confidence_of, fitted to kept pixels of the
# sample room (exact depth) and of 7-Scenes kitchen (sensor depth), both counting alike.
WEIGHTS = (-1.077, 0.477, 0.107, -0.711)
BIAS = 2.12
LEAST, MOST = 0.02, 0.99


def remove_speckles(depth: Float32, step: float, smallest: int) -> Float32:
    """Depth (H, W) without patches smaller than ``smallest`` pixels.

    Neighbours (above, below, beside) belong together up to ``step``, a relative difference.
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
    """The weighted median of known depths round each known pixel, of every other pixel of a square.

    Neighbours of another luminance (``guide``) count less.
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
def enlarge(
    depth: Float32, guide: Float32, fine_guide: Float32, trust: Float32
) -> tuple[Float32, Float32]:
    """A depth map (h, w) and its trust at the size of a larger picture, with the picture's edges.

    Among the four depths round a pixel, those that lie near the most alike one are averaged, by
    nearness and likeness of luminance; a pixel whose nearest depth is unknown stays unknown.
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


def trim_outlines(depth: Float32, rgb: Bytes, radius: int) -> Float32:
    """Depth without the pixels whose look-alikes nearby are mostly unknown, again and again.

    ``radius`` is that of the pixels that vote, a little more than half the matched window.
    """
    import cv2

    votes = np.exp(-np.arange(256) / (255 * ALIKE)).astype(np.float32)
    side = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    for _ in range(ROUNDS):
        asked = (depth > 0) & (cv2.dilate((depth <= 0).astype(np.uint8), side) > 0)
        gone = _outvoted(depth, asked, rgb, radius, votes)
        if not gone.any():
            break
        depth = np.where(gone, np.float32(0), depth)
    return depth


@compiled(parallel=True)
def _outvoted(
    depth: Float32, asked: NDArray[np.bool_], rgb: Bytes, radius: int, votes: Float32
) -> NDArray[np.bool_]:
    """(H, W) which of the asked pixels have more unknown than known neighbours that look alike."""
    height, width = depth.shape
    gone = np.zeros((height, width), np.bool_)
    for y in prange(height):
        for x in range(width):
            if not asked[y, x]:
                continue
            balance = np.float32(-1)  # a tie, and one vote more, keep the depth
            for ny in range(max(y - radius, 0), min(y + radius + 1, height)):
                for nx in range(max(x - radius, 0), min(x + radius + 1, width)):
                    # Every other pixel of the square, as for the matched window.
                    if (ny - y + nx - x) % 2 != 0:
                        continue
                    vote = votes[_unlike(rgb, y, x, ny, nx)]
                    balance += -vote if depth[ny, nx] > 0 else vote
            gone[y, x] = balance > 0
    return gone


@compiled()
def regrow(
    depth: Float32, candidates: Float32, rgb: Bytes, tolerance: float, steps: int
) -> Float32:
    """Depth continued into its candidates, pixel by pixel, where colour and depth run on.

    Two neighbours belong together up to ``tolerance``, relative; it grows ``steps`` pixels far.
    """
    height, width = depth.shape
    grown = depth.copy()
    front, ahead = np.empty(height * width, np.int32), np.empty(height * width, np.int32)
    count = 0
    for cell in range(height * width):
        if depth[cell // width, cell % width] > 0:
            front[count] = cell
            count += 1
    most = int(255 * SAME)
    for _ in range(steps):
        found = 0
        for i in range(count):
            y, x = front[i] // width, front[i] % width
            for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                ny, nx = y + dy, x + dx
                if ny < 0 or nx < 0 or ny >= height or nx >= width or grown[ny, nx] > 0:
                    continue
                there, here = candidates[ny, nx], grown[y, x]
                if not there > 0 or abs(there - here) > tolerance * min(there, here):
                    continue
                if _unlike(rgb, y, x, ny, nx) <= most:
                    grown[ny, nx] = there
                    ahead[found] = ny * width + nx
                    found += 1
        front, ahead, count = ahead, front, found
    return grown


@compiled(inline="always")
def _unlike(rgb, y, x, ny, nx):
    """The largest difference of a channel, 0 to 255."""
    most = np.int64(0)
    for c in range(3):
        most = max(most, abs(np.int64(rgb[ny, nx, c]) - np.int64(rgb[y, x, c])))
    return most


@dataclass(frozen=True, eq=False)
class Agreement:
    """How a view's depth stands to that of other views."""

    views: torch.Tensor  # (H, W) int64, how many others confirm each pixel
    spread: torch.Tensor  # (H, W) float32, mean relative difference to those that do; 0 without any
    inverse_depth: torch.Tensor  # (H, W) float32, mean of the view's own and the confirming views'


def agreement(
    inverse_depth: torch.Tensor,
    reference: Cameras,
    others: Sequence[tuple[torch.Tensor, Cameras]],
    *,
    tolerance: float,
) -> Agreement:
    """Compare a view's inverse depth (H, W), 0 where unknown, with that of other views of any size.

    Each pixel is carried into the other view, that view's depth is read there, and carried back
    along the pixel's own ray: it confirms when both depths differ by no more than ``tolerance``,
    relative.
    """
    height, width = inverse_depth.shape
    v, u = pixel_centers(height, width, inverse_depth.device)
    known = inverse_depth > 0
    count = torch.zeros((height, width), dtype=torch.int64, device=inverse_depth.device)
    total = torch.zeros_like(inverse_depth)
    spread = torch.zeros_like(inverse_depth)
    for other, camera in others:
        warps = relative_warps(reference, camera)
        A, o = warps.matrix[0].astype(np.float32), warps.offset[0].astype(np.float32)
        x, y, z = (
            float(A[i, 0]) * u + float(A[i, 1]) * v + float(A[i, 2]) + inverse_depth * float(o[i])
            for i in range(3)
        )
        z = torch.where(z > 1e-6, z, torch.ones_like(z))
        column, row = (x / z).floor().long(), (y / z).floor().long()
        inside = (column >= 0) & (row >= 0) & (column < other.shape[1]) & (row < other.shape[0])
        inside &= known & (z > 1e-6)
        cell = row.clamp(0, other.shape[0] - 1) * other.shape[1] + column.clamp(
            0, other.shape[1] - 1
        )
        theirs = other.reshape(-1)[cell]
        inside &= theirs > 0
        # z is the other view's depth over the reference's; the same ratio carries it back.
        seen = torch.where(inside, theirs * z, torch.ones_like(theirs))
        difference = inverse_depth / seen - 1
        near = inside & (difference.abs() <= tolerance)
        count += near
        total += torch.where(near, OTHERS * seen, torch.zeros_like(seen))
        spread += torch.where(near, difference.abs(), torch.zeros_like(seen))
    mean = (inverse_depth + total) / (1 + OTHERS * count)
    return Agreement(
        count, spread / count.clamp(min=1), torch.where(known, mean, torch.zeros_like(mean))
    )


def confidence_of(cost: torch.Tensor, views: torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """Predicted probability that the depth's relative error is below RIGHT.

    By photometric cost, how many other views confirm, and the mean relative difference to these.
    """
    number = views.to(cost.dtype)
    features = torch.stack([cost, number.clamp(max=4), (number >= 2).to(cost.dtype), 100 * spread])
    weights = torch.tensor(WEIGHTS, device=cost.device)
    logit = (features * weights[:, None, None]).sum(0) + BIAS
    return torch.sigmoid(logit).clamp(LEAST, MOST)
