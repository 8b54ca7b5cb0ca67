"""Level of detail: thinned copies of a tile's segments, for distant cameras.

In a copy, the observations of a segment that lie in one cube of 4, or of 16, voxels a side become
one, their mean weighted by confidence. So a copy's segments have the same block and view.
"""

# mypy: no-check-untyped-defs

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled
from gvtools.memory.store.store import Store
from gvtools.memory.store.voxel_index import LOCAL_MASK

# The cubes of the copies are 2**2 and 2**4 voxels wide.
DOUBLINGS = (2, 4)


class Drawn(NamedTuple):
    """The columns that splatting reads: (N, 3), (N, 3), (N,) and (N,), see ColumnArrays."""

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    spacing: NDArray[np.float32]


class ThinnedCopy(NamedTuple):
    """One copy: the observations, and where each segment's begin, (S + 1,) int32."""

    start: NDArray[np.int32]
    rows: Drawn


def drawn(count: int) -> Drawn:
    """Uninitialised columns for ``count`` observations."""
    single = np.float32
    return Drawn(
        np.empty((count, 3), single), np.empty((count, 3), np.uint8),
        np.empty(count, single), np.empty(count, single),
    )  # fmt: skip


def thinned_copy(store: Store, doublings: int) -> ThinnedCopy:
    """The copy of a tile whose cubes are 2**doublings voxels wide."""
    segments, arrays = store.segments, store.columns.arrays
    rows = drawn(len(store))
    start = np.zeros(segments.count + 1, np.int32)
    n = _thin(
        segments.start[: segments.count], segments.length, arrays.positions, arrays.colors,
        arrays.confidence, arrays.spacing, arrays.level, 1.0 / store.voxel, doublings, start, *rows,
    )  # fmt: skip
    kept = Drawn(
        rows.positions[:n].copy(), rows.colors[:n].copy(),
        rows.confidence[:n].copy(), rows.spacing[:n].copy(),
    )  # fmt: skip
    return ThinnedCopy(start, kept)


@compiled()
def _thin(
    first, length, positions, colors, confidence, spacing, level, inverse_edge, doublings,
    start, out_positions, out_colors, out_confidence, out_spacing,
):  # fmt: skip
    side = (LOCAL_MASK + 1) >> doublings
    place = np.full(side * side * side, -1, np.int64)
    used = np.empty(side * side * side, np.int64)
    # Weighted position and colour, weight, weighted spacing.
    total = np.empty((side * side * side, 8), np.float64)
    n = 0
    for s in range(len(first)):
        cubes = 0
        inverse = inverse_edge / (1 << np.int64(level[first[s]]))
        for r in range(first[s], first[s] + length[s]):
            cube = np.int64(0)
            for k in range(3):
                voxel = np.int64(np.floor(np.float64(positions[r, k]) * inverse))
                cube = cube * side + ((voxel & LOCAL_MASK) >> doublings)
            t = place[cube]
            if t < 0:
                t = place[cube] = cubes
                used[cubes] = cube
                cubes += 1
                total[t] = 0
                out_confidence[n + t] = 0
            w = np.float64(confidence[r])
            for k in range(3):
                total[t, k] += w * positions[r, k]
                total[t, 3 + k] += w * colors[r, k]
            total[t, 6] += w
            total[t, 7] += w * spacing[r]
            out_confidence[n + t] = max(out_confidence[n + t], confidence[r])
        for t in range(cubes):
            weight = total[t, 6]
            for k in range(3):
                out_positions[n, k] = total[t, k] / weight
                out_colors[n, k] = np.uint8(total[t, 3 + k] / weight + 0.5)
            out_spacing[n] = max(total[t, 7] / weight, (1 << doublings) / inverse)
            place[used[t]] = -1
            n += 1
        start[s + 1] = n
    return n


@compiled()
def copy_rows(begin, end, which, start, length, source, at, target):
    """Copy segments ``which[begin:end]`` into ``target``.

    Args:
        begin: of the part, see ``in_threads``.
        end: likewise.
        which: (n,) int64, the segments.
        start: (n,) int64, where each begins in ``source``.
        length: (n,) int64.
        source: Drawn.
        at: (n,) int64, where each begins in ``target``.
        target: Drawn, is written.
    """
    for i in range(begin, end):
        j = which[i]
        a, b, n = start[j], at[j], length[j]
        for r in range(n):
            for k in range(3):
                target.positions[b + r, k] = source.positions[a + r, k]
                target.colors[b + r, k] = source.colors[a + r, k]
            target.confidence[b + r] = source.confidence[a + r]
            target.spacing[b + r] = source.spacing[a + r]
