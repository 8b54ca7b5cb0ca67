"""Observations of some segments, brought together from their tiles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import in_threads
from gvtools.memory.tiles.thinned_copies import Drawn, copy_rows, drawn
from gvtools.memory.tiles.tile import DRAWN_BYTES
from gvtools.memory.tiles.tile_set import TileSet

# The share of the budget that is gathered at a time.
SHARE = 1 / 8


@dataclass(frozen=True, eq=False)
class Gathered:
    """Segments one behind the other.

    Attributes:
        rows: the observations.
        start: (n,) int64, where each segment begins.
        length: (n,) int32.
    """

    rows: Drawn
    start: NDArray[np.int64]
    length: NDArray[np.int32]


def gather(
    tiles: TileSet,
    chosen: NDArray[np.int64],
    length: NDArray[np.int32],
    *,
    doublings: NDArray[np.uint8] | None = None,
) -> Gathered:
    """Read segments, in their order; tiles that hold none of them are not touched.

    Args:
        tiles: of the memory.
        chosen: (n,) rows of the memory's table.
        length: (n,) of these segments.
        doublings: (n,) of the thinned copy to take each from, 0 = every observation; None is 0.
    """
    with tiles.lock:
        places = tiles.places
        tile, start = places.tile[chosen], places.row[chosen]
        count = length.astype(np.int64)
        kind = np.zeros(len(chosen), np.uint8) if doublings is None else doublings
        groups = []
        key = tile.astype(np.int64) * 16 + kind
        order = np.argsort(key, kind="stable")
        ends = np.flatnonzero(np.diff(key[order])) + 1
        for which in np.split(order, ends) if len(order) else ():
            number, twice = int(tile[which[0]]), int(kind[which[0]])
            groups.append((number, twice, which))
            if twice:
                copy = tiles[number].thinned(twice)
                local = places.local[chosen[which]]
                start[which] = copy.start[local]
                count[which] = copy.start[local + 1] - copy.start[local]
        ends = np.cumsum(count)
        rows = drawn(int(ends[-1]) if len(ends) else 0)
        at = ends - count
        for number, twice, which in groups:
            source = tiles[number].thinned(twice).rows if twice else tiles[number].drawn()
            in_threads(copy_rows, len(which), which, start, count, source, at, rows)
            tiles.touch(number)
            tiles.shrink(keep=number)
    return Gathered(rows, at, count.astype(np.int32))


def parts_of(
    chosen: NDArray[np.int64], length: NDArray[np.int32], tiles: TileSet
) -> Iterator[NDArray[np.int64]]:
    """Segments in order, in parts that hold as many observations as may be gathered at a time.

    Args:
        chosen: (n,) the segments, or what stands for them.
        length: (n,) observations of each.
        tiles: of the memory.
    """
    most = int(SHARE * tiles.budget) // DRAWN_BYTES
    ends = np.cumsum(length, dtype=np.int64)
    first = 0
    while first < len(chosen) or not first:
        done = int(ends[first - 1]) if first else 0
        last = max(int(np.searchsorted(ends, done + most, side="right")), first + 1)
        yield chosen[first:last]
        first = last
