"""A memory that may be larger than RAM: what outgrows its budget is kept in tiles on disk.

It begins like any memory, wholly in RAM. Once it takes more than half of its budget (the rest is
room for copies while arrays grow), its observations move to tiles. A tile covers a cube of space.
It is a Store of its own, in RAM while it is used, in a file otherwise.

A segment is the stored sequence of one view's observations in one block (16 x 16 x 16 voxels of one
level). The table of all segments stays in RAM, in the order that it would have without tiles, so
that culling and the choice of what is drawn are the same; chosen segments are copied from tiles.
"""

from __future__ import annotations

from copy import copy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import OptionError
from gvtools.memory import fusion
from gvtools.memory.fusion import Fused, FuseReport
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.store.columns import Columns, Segments
from gvtools.memory.store.points import PointSet
from gvtools.memory.store.store import MemoryOptions, Store
from gvtools.memory.store.views import ViewTable
from gvtools.memory.store.voxel_index import VoxelIndex, group_by_block
from gvtools.memory.tiles.octree import WHOLE
from gvtools.memory.tiles.tile import Tile
from gvtools.memory.tiles.tile_set import TileSet

# A memory moves to tiles when it takes more than this share of the budget.
IN_RAM = 0.5
# RAM for an observation: columns, index, its share of segments and of the log of agreements.
OBSERVATION_BYTES = 64


class _NewSegments(NamedTuple):
    """S segments that one view adds to a tile.

    Attributes:
        first: (S,) index of the view's first point in the segment's block.
        number: (S,) number of the tile.
        local: (S,) row of the segment in the tile's own table.
        start: (S,) row of the segment's first observation in the tile.
        level: (S,) of its voxels: 2**level finest voxels wide.
        length: (S,) number of observations.
        view: (S,) row of the view.
        box: (S, 7) see Segments.
    """

    first: NDArray[np.int64]
    number: NDArray[np.int32]
    local: NDArray[np.int32]
    start: NDArray[np.int64]
    level: NDArray[np.uint8]
    length: NDArray[np.int32]
    view: NDArray[np.int32]
    box: NDArray[np.float32]


def _new_segments(
    store: Store, number: int, before: int, *, first: NDArray[np.int64]
) -> _NewSegments:
    """A tile's segments from row ``before`` of its table on."""
    s, span = store.segments, slice(before, store.segments.count)
    start = s.start[span].copy()
    return _NewSegments(
        first, np.full(len(first), number, np.int32),
        np.arange(before, s.count, dtype=np.int32), start, store.columns.level[start],
        s.length[span].copy(), s.view[span].copy(), s.box[span].copy(),
    )  # fmt: skip


class PagedColumns(Columns):
    """Stands for the columns of a memory in tiles: it knows only the number of observations."""

    def __init__(self) -> None:
        self.device, self.count = "cpu", 0

    def tensor(self, name: str) -> Any:
        """Refuse: there are no columns in RAM."""
        raise OptionError(
            f"the memory's {self.count:,} observations are in tiles on disk, larger than its "
            "budget; take memory.overview(MOST) for at most so many of them in RAM, or raise "
            "memory.budget"
        )

    @property
    def arrays(self) -> Any:
        """Refuse; see ``tensor``."""
        return self.tensor("")

    def cloud(self) -> Any:
        """Refuse; see ``tensor``."""
        return self.tensor("")


class TiledMemory(SpatialMemory):
    """A SpatialMemory with a budget of RAM: the same methods, the same results.

    Observations are the same to the bit, whatever the budget. Pictures are, too, unless a block (16
    voxels a side) of wide voxels is larger than its tile; then colours are summed in another order
    there.

    Args:
        voxel: see Store, as the others.
        origin: see Store.
        axes: see Store.
        options: with a ``budget``.
        scratch: folder for the files of tiles that are not in RAM; None takes the system's for
            temporary files. They are deleted with the memory; ``save`` keeps them.

    >>> memory = TiledMemory(voxel=0.05, options=MemoryOptions(budget="400MB"))
    >>> len(memory), memory.tiles is None
    (0, True)

    Raises:
        OptionError: no budget.
    """

    def __init__(
        self,
        voxel: float,
        *,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        axes: ArrayLike | None = None,
        options: MemoryOptions | None = None,
        scratch: Path | None = None,
    ) -> None:
        super().__init__(voxel, origin=origin, axes=axes, options=options)
        if self.options.budget is None:
            raise OptionError("memory.budget none; expected bytes, such as 4GB; use SpatialMemory")
        self.scratch = scratch

    def fuse(
        self, points: PointSet, *, round: int, generated: bool = False, scanned: bool = False
    ) -> FuseReport:
        """Fuse one view's points; see SpatialMemory.fuse.

        Raises:
            OptionError: see SpatialMemory.fuse, as of ShapeError.
            ProjectError: the disk is full; what was there before is intact.
        """
        take = None if self.tiles is None else self._fuse_tiles
        report = fusion.fuse(
            self, points, round=round, generated=generated, scanned=scanned, take=take
        )
        self._divide_if_large()
        return report

    def _divide_if_large(self) -> None:
        assert self.options.budget is not None
        if self.tiles is None and self.stored_bytes > IN_RAM * self.options.budget:
            self._move_to_tiles()

    def _move_to_tiles(self) -> None:
        """Make one tile of all observations, and divide it."""
        whole = self._empty()
        whole.columns, whole.segments, whole.index = self.columns, self.segments, self.index
        whole.agreements = self.agreements
        count, n = len(self), self.segments.count
        rows = np.arange(n, dtype=np.int32)
        tile = Tile(WHOLE, rows, whole)
        tile.changed()
        first = whole.segments.start[:n]
        level = whole.columns.level[first]
        tiles = self.begin_tiles()
        tiles.places.append(np.zeros(n, np.int32), rows, first, level=level)
        self.segments = copy(self.segments)
        for name in (*Segments.ARRAYS, "group_box"):
            setattr(self.segments, name, getattr(self.segments, name).copy())
        self.columns.count = count
        number = tiles.add(tile)
        tiles.divide_large([number])
        tiles.shrink()

    def begin_tiles(self) -> TileSet:
        """Keep observations in tiles from now on; starts with no tile."""
        assert self.options.budget is not None
        self.columns, self.index, self.agreements = PagedColumns(), VoxelIndex(), {}
        self.tiles = TileSet(self._empty, budget=self.options.budget, scratch=self.scratch)
        return self.tiles

    def _empty(self) -> Store:
        """A tile's store without observations; it shares the table of views."""
        frame = self.frame
        store = Store(self.voxel, origin=frame.origin, axes=frame.axes, options=self.options)
        store.views = self.views
        return store

    def _fuse_tiles(self, columns: list[NDArray[Any]], view: int) -> FuseReport:
        """Fuse a view's checked points, sorted by tile, tile by tile."""
        tiles = self.tiles
        assert tiles is not None
        with tiles.lock:
            numbers = tiles.tiles_of(np.ascontiguousarray(columns[0]), columns[3], self.levels)
            touched, starts, order = group_by_block(numbers, len(tiles.tiles))
            total = FuseReport()
            new: list[_NewSegments] = []
            for g, number in enumerate(touched.tolist()):
                rows = order[starts[g] : starts[g + 1]]
                store = tiles.load(number)
                before = store.segments.count
                fused = fusion.fuse_columns(
                    store, [column.take(rows, axis=0) for column in columns], view
                )
                total += fused.report
                new.append(_new_segments(store, number, before, first=rows[fused.first_point]))
                self._update_boxes(tiles[number], fused, before)
                tiles[number].changed()
                tiles.touch(number)
                tiles.shrink(keep=number)
            if new:
                self._append_segments(new)
            self.columns.count += total.added
            tiles.divide_large(touched.tolist())
            tiles.shrink()
        return total

    def _update_boxes(self, tile: Tile, fused: Fused, before: int) -> None:
        """Copy the boxes of a tile's older segments, which new points may widen, to the table."""
        assert tile.store is not None
        rows = tile.segments[fused.first_changed : before]
        box = tile.store.segments.box[fused.first_changed : before]
        differs = (self.segments.box[rows] != box).any(axis=1)
        self.segments.widen(rows[differs], box[differs])

    def _append_segments(self, new: list[_NewSegments]) -> None:
        """Enter new segments in the table by their first points: the order without tiles."""
        tiles = self.tiles
        assert tiles is not None
        order = np.argsort(np.concatenate([part.first for part in new]), kind="stable")
        row = np.empty(len(order), np.int32)
        row[order] = np.arange(self.segments.count, self.segments.count + len(order))
        at = 0
        for part in new:
            tile = tiles[part.number[0]] if len(part.number) else None
            if tile is not None:
                rows = row[at : at + len(part.first)]
                tile.segments = np.concatenate([tile.segments, rows])
            at += len(part.first)
        all_ = _NewSegments(*(np.concatenate(column)[order] for column in zip(*new, strict=True)))
        start = self.columns.count + np.cumsum(all_.length, dtype=np.int64) - all_.length
        self.segments.append(start, all_.length, all_.view, box=all_.box)
        tiles.places.append(all_.number, all_.local, all_.start, level=all_.level)

    @property
    def voxels(self) -> int:
        """Number of occupied voxels."""
        if self.tiles is None:
            return super().voxels
        return sum(tile.voxels for _, tile in self.tiles)

    @property
    def stored_bytes(self) -> int:
        """Bytes of observations, segments, index and agreements, in RAM or in files."""
        if self.tiles is None:
            return super().stored_bytes
        return self.segments.nbytes + sum(tile.size for _, tile in self.tiles)

    def drop_views(self, keep_view: NDArray[np.bool_], kept: ViewTable, *, round: int) -> int:
        """Remove the views that are not kept; see Store.drop_views."""
        if self.tiles is None:
            return super().drop_views(keep_view, kept, round=round)
        tiles, before = self.tiles, len(self)
        segments, n = self.segments, self.segments.count
        stays = keep_view[segments.view[:n]]
        # Views after the first removed one get new rows, so their tiles change, too.
        first = int(np.argmin(keep_view))
        touched = set(np.unique(tiles.places.tile[:n][segments.view[:n] >= first]).tolist())
        touched |= {number for number, tile in tiles if round in tile.agreed}
        new_row = (np.cumsum(stays) - 1).astype(np.int32)
        new_view = (np.cumsum(keep_view) - 1).astype(np.int32)
        length = segments.length[:n][stays]
        with tiles.lock:
            tiles.places.select(stays)
            for number, tile in list(tiles):
                kept_rows = tile.segments[stays[tile.segments]]
                tile.segments = new_row[kept_rows]
                if number in touched:
                    store = tiles.load(number)
                    store.drop_views(keep_view, kept, round=round)
                    tile.changed()
                    tiles.places.move(tile.segments, number, store.segments)
                    tiles.touch(number)
                    tiles.shrink(keep=number)
                elif tile.store is not None:
                    tile.store.views = kept
            self.views = kept
            self.segments = Segments()
            self.segments.append(
                np.cumsum(length, dtype=np.int64) - length, length,
                new_view[segments.view[:n][stays]], box=segments.box[:n][stays],
            )  # fmt: skip
            self.columns.count = int(length.sum(dtype=np.int64))
        return before - len(self)

    def compact(self) -> int:
        """Join small neighbouring tiles, as after ``forget``; returns how many fewer there are."""
        if self.tiles is None:
            return 0
        with self.tiles.lock:
            return self.tiles.join_small()

    def overview(self, most: int | None = None) -> SpatialMemory:
        """A memory in RAM of at most ``most`` observations, for code that needs a whole memory.

        If all observations fit, it equals this memory without tiles, to the bit except for the
        order of agreements within a round. Otherwise it is made of thinned copies, in which each
        view keeps one observation for each cube of 4, or of 16, voxels a side; confidence that
        later rounds added to these stays if such a round is forgotten.

        Args:
            most: None: as many as half of the budget holds.
        """
        if self.tiles is None:
            return self
        from gvtools.memory.tiles.overview import overview

        assert self.options.budget is not None
        room = int(IN_RAM * self.options.budget) // OBSERVATION_BYTES
        return overview(self, self.tiles, room if most is None else most)

    def save(self, path: Path | str) -> Path:
        """Write the memory: a file as SpatialMemory writes it, or a folder of tiles.

        Args:
            path: the file; tiles go to the folder of the same name with the suffix ``.tiles``.

        Returns:
            Where it is.

        Raises:
            ProjectError: the disk is full or the folder cannot be written; what was there before
                is intact.
        """
        from gvtools.memory.io.tile_folder import save_tiles, tile_folder

        path = Path(path)
        if self.tiles is None:
            return super().save(path)
        return save_tiles(self, self.tiles, tile_folder(path))

    @classmethod
    def load(
        cls, path: Path | str, *, budget: int | None = None, scratch: Path | None = None
    ) -> TiledMemory:
        """Read a memory that was saved as a file or as tiles.

        Args:
            path: the path given to ``save``, or the folder of tiles.
            budget: bytes; None takes the budget saved with tiles.
            scratch: see TiledMemory; if given, the saved folder may be removed afterwards.

        Raises:
            MemoryFileError: absent, truncated, altered, of another kind or version.
            OptionError: no budget for a memory that was saved as a file.
        """
        from gvtools.memory.io.tile_folder import load_tiles, tile_folder

        folder = tile_folder(Path(path))
        if folder.is_dir():
            return load_tiles(cls, folder, budget=budget, scratch=scratch)
        whole = SpatialMemory.load(path)
        memory = cls(
            whole.voxel, origin=whole.origin, axes=whole.frame.axes, scratch=scratch,
            options=whole.options.replaced(budget=budget),
        )  # fmt: skip
        for name in ("columns", "segments", "views", "index", "agreements"):
            setattr(memory, name, getattr(whole, name))
        memory._divide_if_large()
        return memory
