"""The container of a memory's observations: one tile in RAM, or many of which some are in files.

Tiles are cubes of an octree over cells that are 128 finest voxels wide. The widest voxel is one
cell wide, so a voxel of any level lies in one tile, and each tile can be fused by itself.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.kernels import in_threads
from gvtools.memory.store.observations import Observations, SegmentPlaces, Segments, SplatColumns
from gvtools.memory.store.tile import SPLAT_BYTES, Node, Tile, copy_rows, empty_columns
from gvtools.memory.store.views import ViewTable
from gvtools.memory.store.voxel_index import (
    COORDINATE_BITS,
    EMPTY_KEY,
    VoxelIndex,
    VoxelLevels,
    group_by_block,
    voxel_keys,
)

# Cells are the blocks of voxels of this level: 16 voxels, each 8 finest voxels wide.
CELL_LEVEL = 3
# Level of the cube of all cells.
ROOT = COORDINATE_BITS
_MASK = (1 << COORDINATE_BITS) - 1
# Key of points beyond all cells; only the widest voxels reach there. They share the tile FAR.
FAR_KEY = np.int64(1 << 62)
FAR: Node = (ROOT + 1, 0, 0, 0)
WHOLE: Node = (ROOT, 0, 0, 0)
# A memory moves to tiles when it takes more than this share of its budget.
IN_RAM = 0.5
# Shares of the budget: all tiles in RAM together, the largest tile, and what is gathered at a time.
CACHE, LARGEST, GATHERED = 0.6, 1 / 32, 1 / 8
# Tiles of fewer bytes are not divided, which would give too many files.
SMALLEST = 1 << 18


class Gathered(NamedTuple):
    """Observations of ``chosen`` segments, by the rows of ``start`` and ``length``.

    ``table``: which segments these rows are, by the memory's table; None where they are all of it.
    """

    chosen: NDArray[np.int64]
    start: NDArray[np.int64]
    length: NDArray[np.int32]
    columns: SplatColumns
    table: NDArray[np.int64] | None

    def of(self, array: NDArray) -> NDArray:
        """What ``array`` holds of these rows, where it has one for each segment of the memory."""
        return array if self.table is None else array[self.table]


class TileSet:
    """A memory's observations in tiles.

    At first there is one, ``whole``, in RAM. Once it takes more than half of the budget (the rest
    is room for copies while arrays grow), it is divided into cubes of space, each in RAM while it
    is used and in a file otherwise; the least recently used ones are written to files.

    The files of the working folder are scratch: ``save`` hard-links them elsewhere. A file is never
    changed, as a saved memory may share it: a tile's next state gets another name.
    """

    def __init__(self, whole: Observations, views: ViewTable) -> None:
        self.whole: Observations | None = whole
        self._voxel, self._weight_cap = whole.voxel, whole.weight_cap
        self.views = views
        # Bytes; tiles in RAM may take the share CACHE of it. None keeps the whole in RAM.
        self.budget: int | None = None
        # Where the working folder is made; None: the system's folder for temporary files.
        self.scratch: Path | None = None
        # By number; None for a tile that was divided or joined.
        self.tiles: list[Tile | None] = [Tile(WHOLE, store=whole)]
        self.octree = Octree()
        self.places = SegmentPlaces()
        # Held while tiles are read, written or moved.
        self.lock = threading.RLock()
        # Bytes of a tile that is being divided, so that its parts find room beside it.
        self.reserved = 0
        self._recent: OrderedDict[int, int] = OrderedDict()
        # Bytes that tiles take in RAM.
        self.resident = 0
        self._folder: Path | None = None
        self._remove: Callable[[], object] = lambda: None
        self._writes = 0

    def clear(self) -> None:
        """Begin with no tile, in files."""
        self.whole, self.tiles = None, []

    def page(self) -> Segments | None:
        """Divide a whole that takes half of the budget; returns the table of all segments."""
        whole = self.whole
        if whole is None or self.budget is None or whole.nbytes <= IN_RAM * self.budget:
            return None
        self.clear()
        rows = np.arange(whole.segments.count, dtype=np.int32)
        first = whole.segments.start[: len(rows)]
        level = whole.columns.level[first]
        self.places.append_rows(np.zeros(len(rows), np.int32), rows, first, level)
        table = Segments()
        table.follow(*(whole.segments.rows()[name] for name in ("length", "view", "box")))
        tile = Tile(WHOLE, rows, whole)
        tile.changed()
        self.divide_large([self.add(tile)])
        self.shrink()
        return table

    def __iter__(self) -> Iterator[tuple[int, Tile]]:
        return ((i, tile) for i, tile in enumerate(self.tiles) if tile is not None)

    def __getitem__(self, number: int) -> Tile:
        tile = self.tiles[number]
        assert tile is not None
        return tile

    def each(self) -> Iterator[Tile]:
        """Every tile, to be read one by one; earlier ones are evicted if RAM is needed."""
        for number, tile in list(self):
            with self.lock:
                yield tile
                self.touch(number)
                self.shrink(keep=number)

    @property
    def size(self) -> int:
        """Bytes of all tiles, in RAM or in files."""
        if self.whole is not None:
            return self.whole.nbytes
        return sum(tile.size for _, tile in self)

    @property
    def voxels(self) -> int:
        """Number of occupied voxels."""
        if self.whole is not None:
            return self.whole.index.voxels
        return sum(tile.voxels for _, tile in self)

    @property
    def largest(self) -> int:
        """Bytes above which a tile is divided."""
        return max(SMALLEST, int(LARGEST * (self.budget or 0)))

    @property
    def folder(self) -> Path:
        """The working folder, made when first needed and deleted with the memory."""
        if self._folder is None:
            try:
                ours = self.scratch if self.scratch and not self.scratch.exists() else None
                if ours:
                    ours.mkdir(parents=True)
                self._folder = Path(tempfile.mkdtemp(prefix="gvtools-tiles-", dir=self.scratch))
            except OSError as error:
                raise ProjectError(
                    f"{self.scratch}: no folder for tiles can be made ({error.strerror}); expected "
                    "one that can be written"
                ) from None
            self._remove = weakref.finalize(self, _remove_scratch, self._folder, ours)
        return self._folder

    def close(self) -> None:
        """Remove the working folder, and with it everything that was not saved."""
        self._remove()

    def add(self, tile: Tile) -> int:
        """Add a tile; returns its number."""
        self.tiles.append(tile)
        number = len(self.tiles) - 1
        self.octree.leaves[tile.node] = number
        self.touch(number)
        return number

    def load(self, number: int) -> Observations:
        """A tile's observations, read into RAM if they are not there."""
        tile = self[number]
        if tile.store is None:
            tile.load(Observations(self._voxel, self._weight_cap), self.views)
            self.touch(number)
            self.shrink(keep=number)
        assert tile.store is not None
        return tile.store

    def touch(self, number: int) -> None:
        """Note that a tile was used, and how many bytes it takes in RAM now."""
        self.resident += self[number].resident - self._recent.pop(number, 0)
        self._recent[number] = self[number].resident

    def shrink(self, *, keep: int = -1) -> None:
        """Write tiles, but for ``keep``, to files, the least recently used first, until all fit."""
        if self.whole is not None:
            return
        limit = CACHE * (self.budget or 0) - self.reserved - self.places.nbytes
        for number in list(self._recent):
            if self.resident <= max(limit, 0):
                return
            if number != keep and self._recent[number]:
                self.evict(number)

    def evict(self, number: int) -> None:
        """Take a tile out of RAM; if it has changed, it is written first."""
        tile = self[number]
        if tile.dirty:
            self.write(number)
        tile.release()
        self.resident -= self._recent.pop(number, 0)

    def write(self, number: int) -> None:
        """Write a changed tile to a file of a new name, and drop the older one."""
        tile, old = self[number], self[number].file
        owned = tile.owned
        self._writes += 1
        tile.write(self.folder / f"{number:05d}.{self._writes:06d}.tile")
        if owned and old is not None:
            old.unlink(missing_ok=True)

    def write_after(self, name: str) -> None:
        """Number later files after an existing one, so that none gets its name."""
        with suppress(IndexError, ValueError):
            self._writes = max(self._writes, int(name.split(".")[1]))

    def drop(self, number: int) -> None:
        """Remove a tile that was divided or joined."""
        tile = self[number]
        self.resident -= self._recent.pop(number, 0)
        if tile.owned and tile.file is not None:
            tile.file.unlink(missing_ok=True)
        self.tiles[number] = None

    def of_points(
        self, positions: NDArray[np.float32], spacing: NDArray[np.float32], levels: VoxelLevels
    ) -> list[tuple[int, NDArray[np.int64]]]:
        """Numbers of the tiles that points (N,) belong to, with their points; new ones are made."""
        numbers, nodes = self.octree.tiles_of(positions, spacing, levels, free=len(self.tiles))
        for node in nodes:
            self.tiles.append(Tile(node, store=Observations(self._voxel, self._weight_cap)))
            self.touch(len(self.tiles) - 1)
        touched, starts, order = group_by_block(numbers, len(self.tiles))
        return [
            (number, order[starts[g] : starts[g + 1]]) for g, number in enumerate(touched.tolist())
        ]

    def changed(self, number: int) -> None:
        """Note that a tile in RAM has changed."""
        self[number].changed()
        self.touch(number)
        self.shrink(keep=number)

    def split(self, segments: Segments, chosen: NDArray[np.int64]) -> Iterator[slice]:
        """Parts of ``chosen`` rows of the memory's table, in order, that are gathered at a time."""
        if self.whole is not None:
            yield slice(None)
            return
        length = segments.length[chosen]
        ends = np.cumsum(length, dtype=np.int64)
        most = int(GATHERED * (self.budget or 0)) // SPLAT_BYTES
        first = 0
        while first < len(length) or not first:
            done = int(ends[first - 1]) if first else 0
            last = max(int(np.searchsorted(ends, done + most, side="right")), first + 1)
            yield slice(first, last)
            first = last

    def gather(
        self,
        segments: Segments,
        chosen: NDArray[np.int64],
        *,
        doublings: NDArray[np.uint8] | None = None,
    ) -> Gathered:
        """Observations of ``chosen`` (n,) rows of the memory's table, in this order.

        From files they are copied; tiles that hold none of them are not touched. ``doublings`` (n,)
        says which thinned copy of its tile a segment is taken from, 0 = every observation.
        """
        if self.whole is not None:
            columns = self.whole.columns.splat
            return Gathered(chosen, segments.start, segments.length, columns, None)
        with self.lock:
            places = self.places
            tile, start = places.tile[chosen], places.row[chosen]
            count = segments.length[chosen].astype(np.int64)
            kind = np.zeros(len(chosen), np.uint8) if doublings is None else doublings
            groups = []
            key = tile.astype(np.int64) * 16 + kind
            order = np.argsort(key, kind="stable")
            ends = np.flatnonzero(np.diff(key[order])) + 1
            for which in np.split(order, ends) if len(order) else ():
                number, twice = int(tile[which[0]]), int(kind[which[0]])
                groups.append((number, twice, which))
                if twice:
                    thinned = self[number].thinned(twice)
                    local = places.local[chosen[which]]
                    start[which] = thinned.start[local]
                    count[which] = thinned.start[local + 1] - thinned.start[local]
            ends = np.cumsum(count)
            rows = empty_columns(int(ends[-1]) if len(ends) else 0)
            at = ends - count
            for number, twice, which in groups:
                of_tile = self[number]
                source = of_tile.thinned(twice).rows if twice else of_tile.splat_columns()
                in_threads(copy_rows, len(which), which, start, count, source, at, rows)
                self.touch(number)
                self.shrink(keep=number)
        return Gathered(np.arange(len(chosen)), at, count.astype(np.int32), rows, chosen)

    def drop_views(self, table: Segments, keep_view: NDArray[np.bool_], *, round: int) -> None:
        """Remove the views of a round from tiles, see ``Observations.drop_views``.

        ``table`` has all segments as they were before.
        """
        view = table.rows()["view"]
        stays = keep_view[view]
        # Views after the first removed one get new rows, so their tiles change, too.
        first = int(np.argmin(keep_view))
        touched = set(np.unique(self.places.rows()["tile"][view >= first]).tolist())
        touched |= {number for number, tile in self if round in tile.agreed}
        new_row = (np.cumsum(stays) - 1).astype(np.int32)
        with self.lock:
            self.places.select(stays)
            for number, tile in list(self):
                tile.segments = new_row[tile.segments[stays[tile.segments]]]
                if number in touched:
                    observations = self.load(number)
                    observations.drop_views(keep_view, round=round)
                    self.places.move(tile.segments, number, observations.segments)
                    self.changed(number)

    def divide_large(self, numbers: Sequence[int]) -> None:
        """Divide the given tiles that have grown too large, and their parts if need be."""
        left = list(numbers)
        while left:
            number = left.pop()
            tile = self[number]
            if tile.size > self.largest:
                left += self._divide(number)

    def _divide(self, number: int) -> list[int]:
        """Divide a tile; returns its parts' numbers, none if only whole blocks are left."""
        tile = self[number]
        size = tile.size
        if size <= 2 * tile.indivisible or tile.node == FAR:
            return []
        store = self.load(number)
        segments = store.segments
        first = store.columns.positions[segments.start[: segments.count]]
        keys = cell_keys(first, store.voxel)
        cells = cell_coordinates(keys)
        # A part is no smaller than the widest block, so that segments stay whole.
        least = max(0, store.index.top - CELL_LEVEL)
        weight = segments.length[: segments.count].astype(np.float64) * (size / len(store))
        levels, inner = part_levels(cells, weight, tile.node[0], least=least, largest=self.largest)
        nodes = np.column_stack([levels, cells >> levels[:, None]])
        nodes[keys == FAR_KEY] = FAR
        parts, which = np.unique(nodes, axis=0, return_inverse=True)
        if len(parts) == 1:
            tile.indivisible = size
            return []
        self.octree.divide(tile.node)
        self.octree.divided.update(inner)
        voxel_level = int(np.median(self.places.level[tile.segments]))
        self.octree.usual = int(np.median(levels)) - voxel_level
        self.reserved += size
        out = []
        for i, node in enumerate(parts.tolist()):
            rows = np.flatnonzero(which.reshape(-1) == i)
            observations = store.part(rows)
            part = Tile(tuple(node), tile.segments[rows], observations)
            part.changed()
            out.append(self.add(part))
            self.places.move(part.segments, out[-1], observations.segments)
            self.shrink(keep=number)
        self.reserved -= size
        self.drop(number)
        return out

    def join_small(self) -> int:
        """Join small parts of divided cubes; returns how many fewer tiles there are."""
        less = 0
        while True:
            small = [
                (node, parts)
                for node, parts in self.octree.families().items()
                if node != WHOLE
                and sum(self[self.octree.leaves[part]].size for part in parts) < self.largest // 4
            ]
            if not small:
                return less
            for node, parts in small:
                self._join(node, parts)
                less += len(parts) - 1

    def _join(self, node: Node, parts: list[Node]) -> None:
        numbers = [self.octree.leaves[part] for part in parts]
        stores = [self.load(number) for number in numbers]
        rows = np.concatenate([self[number].segments for number in numbers])
        whole = Observations.concatenate(stores)
        tile = Tile(node, rows, whole)
        tile.changed()
        self.octree.join(node, parts, len(self.tiles))
        number = self.add(tile)
        self.places.move(rows, number, whole.segments)
        for old in numbers:
            self.drop(old)
        self.shrink(keep=number)


def cell_keys(positions: NDArray[np.float32], voxel: float) -> NDArray[np.int64]:
    """(N,) int64 key of the cell of each point (N, 3); ``voxel``: edge of the finest voxels."""
    count = len(positions)
    keys, places = np.empty(count, np.int64), np.empty(count, np.uint16)
    levels = np.full(count, CELL_LEVEL, np.uint8)
    if voxel_keys(positions, levels, 1.0 / voxel, keys, places):
        keys[keys == EMPTY_KEY] = FAR_KEY
    return keys


def cell_coordinates(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N, 3) coordinates of cells, 0 to 2**20, by their keys."""
    parts = [(keys >> shift) & _MASK for shift in (2 * COORDINATE_BITS, COORDINATE_BITS, 0)]
    return np.stack(parts, axis=1)


class Octree:
    """An octree whose leaves are the cubes of tiles; the tile of each cell is cached."""

    def __init__(self) -> None:
        # Tile numbers by cube, and cubes that are divided into smaller ones.
        self.leaves: dict[Node, int] = {}
        self.divided: set[Node] = set()
        # Expected level of a tile that holds only the finest voxels, from the last division.
        self.usual = ROOT
        self._cells = VoxelIndex()
        self._keys: list[int] = []
        self._tile = np.empty(0, np.int32)
        self._level = np.empty(0, np.uint8)

    def tiles_of(
        self,
        positions: NDArray[np.float32],
        spacing: NDArray[np.float32],
        levels: VoxelLevels,
        *,
        free: int,
    ) -> tuple[NDArray[np.int32], list[Node]]:
        """The tile of each point (N,), and the cubes of new tiles, numbered from ``free``.

        A new tile's cube is about as large as the parts of the last division, in proportion to its
        voxels, so that it will rarely have to be divided.
        """
        keys = cell_keys(positions, levels.edge)
        before = self._cells.blocks
        cells = self._cells.block_numbers(keys)
        if self._cells.blocks > before:
            new = np.flatnonzero(cells >= before)
            _, first = np.unique(cells[new], return_index=True)
            self._keys += keys[new[first]].tolist()
            self._level = np.concatenate([self._level, levels.of(spacing[new[first]])])
            fresh = np.full(self._cells.blocks - before, -1, np.int32)
            self._tile = np.concatenate([self._tile, fresh])
        made: list[Node] = []
        unknown = np.flatnonzero(self._tile < 0)
        if len(unknown):
            # Only cells of this call: other unknown ones may never be needed again.
            seen = np.zeros(len(self._tile), np.bool_)
            seen[cells] = True
            for cell in unknown[seen[unknown]].tolist():
                node = self._leaf(self._keys[cell], int(self._level[cell]))
                if node not in self.leaves:
                    self.leaves[node] = free + len(made)
                    made.append(node)
                self._tile[cell] = self.leaves[node]
        return self._tile[cells], made

    def _leaf(self, key: int, voxel_level: int) -> Node:
        if key == FAR_KEY:
            return FAR
        x, y, z = cell_coordinates(np.array([key]))[0].tolist()
        node = WHOLE
        while node in self.divided:
            level = node[0] - 1
            node = (level, x >> level, y >> level, z >> level)
        if node in self.leaves:
            return node
        while node[0] > max(0, self.usual + voxel_level):
            self.divided.add(node)
            level = node[0] - 1
            node = (level, x >> level, y >> level, z >> level)
        return node

    def forget_tile(self, number: int) -> None:
        """Drop the cached cells of a tile."""
        self._tile[self._tile == number] = -1

    def divide(self, node: Node) -> None:
        """Turn a leaf into a divided cube."""
        self.forget_tile(self.leaves.pop(node))
        self.divided.add(node)

    def families(self) -> dict[Node, list[Node]]:
        """Divided cubes whose parts are all leaves, with those parts."""
        inner = {parent(node) for node in self.divided if node != WHOLE}
        out: dict[Node, list[Node]] = {}
        for node in self.leaves:
            if node != FAR and node != WHOLE and parent(node) not in inner:
                out.setdefault(parent(node), []).append(node)
        return out

    def join(self, node: Node, parts: list[Node], number: int) -> None:
        """Turn a divided cube into the leaf of tile ``number``, in place of its parts."""
        for part in parts:
            self.forget_tile(self.leaves.pop(part))
        self.divided.discard(node)
        self.leaves[node] = number


def parent(node: Node) -> Node:
    """The cube that a cube is an eighth of."""
    return (node[0] + 1, node[1] >> 1, node[2] >> 1, node[3] >> 1)


def part_levels(
    cells: NDArray[np.int64], weight: NDArray[np.float64], level: int, *, least: int, largest: float
) -> tuple[NDArray[np.int64], list[Node]]:
    """Levels of the parts of a cube that is divided until each part is small enough.

    The cube is 2**level cells wide and holds segments in ``cells`` (S, 3), of ``weight`` (S,) bytes
    each; a part has at least level ``least`` and, if it can, at most ``largest`` bytes. Returns the
    level of each segment's part (S,), and the cubes that were divided.
    """
    levels = np.full(len(cells), level)
    inner: list[Node] = []
    active = np.arange(len(cells))
    while level > least and len(active):
        cubes, which = np.unique(cells[active] >> level, axis=0, return_inverse=True)
        which = which.reshape(-1)
        heavy = np.bincount(which, weight[active]) > largest
        inner += [(level, x, y, z) for x, y, z in cubes[heavy].tolist()]
        active = active[heavy[which]]
        level -= 1
        levels[active] = level
    return levels, inner


def _remove_scratch(folder: Path, scratch: Path | None) -> None:
    """Remove a working folder, and ``scratch`` around it if it was made for it."""
    shutil.rmtree(folder, ignore_errors=True)
    if scratch is not None:
        with suppress(OSError):
            scratch.rmdir()
