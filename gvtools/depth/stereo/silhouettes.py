"""Depth cut back to the picture's silhouettes: an opening by reconstruction, guided by colour.

A window that straddles the outline of a roof matches by the roof even where its centre lies in the
sky, in every view alike, so depth grows past outlines by half a window and consistency confirms it.
Such a rim is thin, looks like the unknown beyond it and unlike the surface that it hangs on. It is
taken back from the outside (``trimmed``). What that takes from the borders of real surfaces grows
again from what remains, wherever depth and colour run on (``regrown``); across an outline colour
does not.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from gvtools.kernels import compiled

Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]

# How fast a neighbour's vote falls with its difference in colour (the largest of the channels), and
# up to which difference depth runs on; a share of the whole range.
ALIKE, SAME = 0.06, 0.03
# Rounds of trimming at most; a rim of half a window is gone after as many as it has pixels.
ROUNDS = 8


def trimmed(depth: Float32, rgb: Bytes, radius: int) -> Float32:
    """Depth without the pixels whose look-alikes nearby are mostly unknown, again and again.

    Args:
        depth: (H, W) float32, 0 = unknown.
        rgb: (H, W, 3) uint8.
        radius: pixels round each pixel that vote, a little more than half the matched window.

    Returns:
        (H, W) float32.
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
def regrown(
    depth: Float32, candidates: Float32, rgb: Bytes, tolerance: float, steps: int
) -> Float32:
    """Depth continued into its candidates, pixel by pixel, where colour and depth run on.

    Args:
        depth: (H, W) float32, 0 = unknown.
        candidates: (H, W) float32, depth that an unknown pixel would get; 0 = none.
        rgb: (H, W, 3) uint8.
        tolerance: relative difference in depth up to which two neighbours belong together.
        steps: how far it grows, pixels (up, down and sideways).

    Returns:
        (H, W) float32.
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
