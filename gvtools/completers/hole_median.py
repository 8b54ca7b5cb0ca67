"""Medians that settle a filled depth map where directions far apart at the rim meet in shards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled, in_threads


@compiled()
def _middle(values, count):
    """The median of the first ``count`` values, an odd number; they are rearranged (Hoare 1961)."""
    middle = count // 2
    low, high = 0, count - 1
    while low < high:
        pivot = values[middle]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    return values[middle]


def median_of_fill(
    inverse: NDArray[np.float64],
    known: NDArray[np.bool_],
    distance: NDArray[np.float64],
    *,
    step: int,
) -> NDArray[np.float64]:
    """5x5 median with holes of ``step`` pixels between its taps, over the fill alone.

    The taps are point-symmetric sets of hole pixels, so planes stay exact. A wide one acts only
    deep inside, where directions far apart at the rim meet in shards.
    """
    result = inverse.copy()
    in_threads(_median_rows, len(inverse), inverse, known, distance, step, result)
    return result


@compiled()
def _median_rows(first, last, inverse, known, distance, step, result):
    height, width = inverse.shape
    values = np.zeros(25)
    for y in range(first, last):
        for x in range(width):
            if inverse[y, x] == 0 or distance[y, x] < (1 if step == 1 else 4 * step):
                continue
            values[0] = inverse[y, x]
            count = np.int64(1)
            for dy in range(3):
                for dx in range(-2, 3):
                    if dy == 0 and dx <= 0:
                        continue
                    ya, xa = y + dy * step, x + dx * step
                    yb, xb = y - dy * step, x - dx * step
                    if ya >= height or yb < 0 or min(xa, xb) < 0 or max(xa, xb) >= width:
                        continue
                    if known[ya, xa] or known[yb, xb]:
                        continue
                    if inverse[ya, xa] == 0 or inverse[yb, xb] == 0:
                        continue
                    values[count], values[count + 1] = inverse[ya, xa], inverse[yb, xb]
                    count += 2
            # The sets have odd size: the centre and pairs.
            result[y, x] = _middle(values, count)
