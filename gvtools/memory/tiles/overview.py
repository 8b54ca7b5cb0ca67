"""A memory in RAM made from one in tiles: of all observations, or of the tiles' thinned copies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.store.columns import LAYOUT
from gvtools.memory.store.views import ViewTable
from gvtools.memory.tiles.gathering import gather
from gvtools.memory.tiles.regrouping import rows_of
from gvtools.memory.tiles.thinned_copies import DOUBLINGS
from gvtools.memory.tiles.tile import COLUMNS
from gvtools.memory.tiles.tile_set import TileSet

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory


def overview(memory: SpatialMemory, tiles: TileSet, most: int) -> SpatialMemory:
    """See TiledMemory.overview."""
    out = memory.blank()
    out.views = ViewTable(memory.frame, memory.views)
    segments, n = memory.segments, memory.segments.count
    with tiles.lock:
        if len(memory) <= most:
            columns = _whole(memory, tiles, out)
            length = segments.length[:n]
        else:
            columns, length = _thinned(memory, tiles, most)
    out.columns.replace(int(length.sum(dtype=np.int64)), columns.__getitem__)
    out.segments.append(
        np.cumsum(length, dtype=np.int64) - length, length, segments.view[:n],
        box=segments.box[:n],
    )  # fmt: skip
    out.rebuild_index()
    return out


def _completed(memory: SpatialMemory, columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Add the columns that follow from the view: round, generated, and empty chains."""
    view = columns["view"]
    made = {"round": memory.views.round[view], "generated": memory.views.generated[view]}
    return {**columns, **made, "next": np.full(len(view), -1, np.int32)}


def _whole(memory: SpatialMemory, tiles: TileSet, out: SpatialMemory) -> dict[str, NDArray[Any]]:
    """Every column in the order of the memory's table; agreements go to ``out``."""
    count, segments = len(memory), memory.segments
    columns: dict[str, NDArray[Any]] = {}
    for name in COLUMNS:
        kind, width = LAYOUT[name]
        columns[name] = np.empty((count, width) if width > 1 else count, kind)
    for tile in tiles.each():
        length = segments.length[tile.segments].astype(np.int64)
        at = rows_of(segments.start[tile.segments], length)
        for name, column in columns.items():
            column[at] = tile.column(name)
        for round_, (rows, weights, before) in tile.agreements():
            entry = (at[rows].astype(np.int32), weights, before)
            out.agreements.setdefault(round_, []).append(entry)
    return _completed(memory, columns)


def _thinned(
    memory: SpatialMemory, tiles: TileSet, most: int
) -> tuple[dict[str, NDArray[Any]], NDArray[np.int32]]:
    """Columns of the finest thinned copies that fit, else of the coarsest; and (n,) lengths."""
    segments, n = memory.segments, memory.segments.count
    doublings = next((d for d in DOUBLINGS if _size(tiles, d) <= most), DOUBLINGS[-1])
    kind = np.full(n, doublings, np.uint8)
    found = gather(tiles, np.arange(n), segments.length[:n], doublings=kind)
    columns: dict[str, NDArray[Any]] = found.rows._asdict()
    columns["view"] = np.repeat(segments.view[:n], found.length)
    columns["level"] = np.repeat(tiles.places.level[:n], found.length)
    return _completed(memory, columns), found.length


def _size(tiles: TileSet, doublings: int) -> int:
    """Observations of the thinned copies of all tiles."""
    return sum(int(tile.thinned(doublings).start[-1]) for tile in tiles.each())
