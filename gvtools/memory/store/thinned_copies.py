"""Thinned copies of observations for distant cameras, and copies of whole segments."""

# mypy: no-check-untyped-defs

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled
from gvtools.memory.store.columns import SplatColumns
from gvtools.memory.store.observations import Observations
from gvtools.memory.store.voxel_index import LOCAL_MASK

# In a copy, the observations of a segment that lie in one cube of 2**2, or of 2**4, voxels a side
# become one, their mean weighted by confidence. So its segments have the same block and view.
DOUBLINGS = (2, 4)


class ThinnedCopy(NamedTuple):
    """One copy: the observations, and where each segment's begin, (S + 1,) int32."""

    start: NDArray[np.int32]
    rows: SplatColumns


def empty_columns(count: int) -> SplatColumns:
    """Uninitialised columns for ``count`` observations."""
    single = np.float32
    return SplatColumns(
        np.empty((count, 3), single), np.empty((count, 3), np.uint8),
        np.empty(count, single), np.empty(count, single),
    )  # fmt: skip


def thinned_copy(observations: Observations, doublings: int) -> ThinnedCopy:
    """The copy whose cubes are 2**doublings voxels wide."""
    segments, arrays = observations.segments, observations.columns.arrays
    rows = empty_columns(len(observations))
    start = np.zeros(segments.count + 1, np.int32)
    n = _thin(
        segments.start[: segments.count], segments.length, *observations.columns.splat,
        arrays.level, 1.0 / observations.voxel, doublings, start, *rows,
    )  # fmt: skip
    return ThinnedCopy(start, SplatColumns(
        rows.positions[:n].copy(), rows.colors[:n].copy(),
        rows.confidence[:n].copy(), rows.spacing[:n].copy(),
    ))  # fmt: skip


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
    """Copy segments ``which[begin:end]`` from ``start`` in ``source`` to ``at`` in ``target``."""
    for i in range(begin, end):
        j = which[i]
        a, b, n = start[j], at[j], length[j]
        for r in range(n):
            for k in range(3):
                target.positions[b + r, k] = source.positions[a + r, k]
                target.colors[b + r, k] = source.colors[a + r, k]
            target.confidence[b + r] = source.confidence[a + r]
            target.spacing[b + r] = source.spacing[a + r]
