"""Which segments hold something clearly in front of a picture, in RAM or in tiles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import in_threads
from gvtools.memory import culling
from gvtools.memory.occlusion import stacked
from gvtools.memory.splat.api import FrameBuffers
from gvtools.memory.store.store import Store
from gvtools.memory.store.views import FreeGrid
from gvtools.memory.tiles.gathering import gather, parts_of


def segments_in_front(
    store: Store,
    later: NDArray[np.int64],
    target: FrameBuffers,
    *,
    z_range: NDArray[np.float32],
    grids: Sequence[FreeGrid],
    margin: float,
) -> NDArray[np.bool_]:
    """Which of some segments hold something that is nearer than the depth written so far.

    Args:
        store: of the segments.
        later: (n,) the segments.
        target: the picture, and the segments' rectangles in it.
        z_range: (R, 2) float32, nearest and farthest depth of each segment.
        grids: what these views saw to be free does not count, see culling.in_front.
        margin: share of the depth by which it has to be nearer.
    """
    farthest, free = culling.tile_farthest(target.depth), stacked(grids)
    K = np.ascontiguousarray(target.camera.K[0])
    hit = np.zeros(len(later), np.bool_)
    if store.tiles is None:
        tables: Iterator[_Part] = iter([_in_ram(store, later, target, z_range=z_range)])
    else:
        near = np.zeros(len(later), np.bool_)
        in_threads(
            culling.may_be_in_front, len(later), later, target.rect, z_range, farthest, margin,
            near,
        )  # fmt: skip
        tables = _in_tiles(store, later, target, z_range=z_range, which=np.flatnonzero(near))
    for which, rows, table, positions in tables:
        found = np.zeros(len(rows), np.bool_)
        in_threads(
            culling.in_front, len(rows), rows, *table, positions, target.cam_from_local, K,
            target.depth, farthest, margin, *free, store.options.free_space_tolerance, found,
        )  # fmt: skip
        hit[which] = found
    return hit


# Which of the segments, their rows in a table, the table (first observation, length, rectangle,
# range of depth), and the positions of its observations.
_Table = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]
_Part = tuple[Any, NDArray[np.int64], _Table, NDArray[np.float32]]


def _in_ram(
    store: Store, later: NDArray[np.int64], target: FrameBuffers, *, z_range: NDArray[np.float32]
) -> _Part:
    segments = store.segments
    table = (segments.start, segments.length, target.rect, z_range)
    return slice(None), later, table, store.columns.positions


def _in_tiles(
    store: Store,
    later: NDArray[np.int64],
    target: FrameBuffers,
    *,
    z_range: NDArray[np.float32],
    which: NDArray[np.int64],
) -> Iterator[_Part]:
    assert store.tiles is not None
    length = store.segments.length
    for part in parts_of(which, length[later[which]], store.tiles):
        rows = later[part]
        found = gather(store.tiles, rows, length[rows])
        table = (found.start, found.length, target.rect[rows], z_range[rows])
        yield part, np.arange(len(rows)), table, found.rows.positions
