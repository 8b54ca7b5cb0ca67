"""Thinning of a memory to one point a voxel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.store.voxel_index import levels_above

if TYPE_CHECKING:
    from gvtools.memory.store.store import Store

# A level and three voxel indices fit one signed 64-bit key while the memory is below a million
# voxels a side.
KEY_BITS = 20


@dataclass(frozen=True, eq=False)
class Thinned:
    """P points out of N observations."""

    # (P,) the observation that stands for its voxel: the most confident, a scan's only where there
    # is no other.
    rows: NDArray[np.int64]
    # (N,) for each observation the point that stands for it; -1 where it was left out.
    group: NDArray[np.int64]
    # Of the thinning's voxels, scene units.
    edge: float


def thin(
    store: Store, max_points: int | None, *, among: NDArray[np.bool_] | None = None
) -> Thinned:
    """One point per voxel; voxels grow from the memory's own until at most ``max_points`` remain.

    Larger ones are counted from the points' least corner: around the origin eight of them would
    stay apart however large they are. ``among`` (N,) says which observations count, at least one.
    """
    chosen = np.arange(len(store)) if among is None else np.flatnonzero(among)
    positions = store.columns.positions[chosen].astype(np.float64)
    # Scans last, and the most confident first; of equals, the earlier observation.
    order = np.lexsort((-store.confidence[chosen], store.scanned[chosen]))
    level = store.columns.level[chosen]
    edge, corner = store.voxel, np.zeros(3)
    while True:
        # Times the inverse, as the memory counts its voxels.
        cells = np.floor((positions - corner) * (1.0 / edge)).astype(np.int64)
        above = levels_above(level, edge / store.voxel)
        cells >>= above[:, None]
        cells -= cells.min(axis=0)
        if int(cells.max()) < 1 << KEY_BITS:
            keys = (above << (3 * KEY_BITS)) | (cells[:, 0] << (2 * KEY_BITS))
            keys |= (cells[:, 1] << KEY_BITS) | cells[:, 2]
            _, first, group = np.unique(keys[order], return_index=True, return_inverse=True)
            if max_points is None or len(first) <= max_points:
                break
            edge *= max(1.1, float(np.sqrt(len(first) / max_points)))
        else:
            edge *= 2.0
        corner = positions.min(axis=0)
    # Points in the order of their observations, so that equal memories give equal files.
    rank = np.argsort(order[first], kind="stable")
    place = np.empty(len(rank), np.int64)
    place[rank] = np.arange(len(rank))
    of_observation = np.full(len(store), -1, np.int64)
    of_observation[chosen[order]] = place[group]
    return Thinned(chosen[order[first][rank]], of_observation, edge)
