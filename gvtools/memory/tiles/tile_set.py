"""The tiles of a memory: which are in RAM, which hold a segment, and how they divide and join."""

from __future__ import annotations

import shutil
import tempfile
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.memory.store.store import Store
from gvtools.memory.store.voxel_levels import VoxelLevels
from gvtools.memory.tiles.octree import (
    FAR,
    FAR_KEY,
    WHOLE,
    Node,
    Octree,
    cell_coordinates,
    cell_keys,
)
from gvtools.memory.tiles.regrouping import joined, part_of
from gvtools.memory.tiles.segment_places import SegmentPlaces
from gvtools.memory.tiles.tile import Tile

# Level of the voxels whose blocks are as wide as a cell, see octree.
BLOCK_LEVEL = 3
# Shares of the budget: all tiles in RAM together, and the largest tile.
CACHE, LARGEST = 0.6, 1 / 32
# Tiles of fewer bytes are not divided, which would give too many files.
SMALLEST = 1 << 18


class TileSet:
    """Tiles, some of them in RAM; the least recently used ones are written to files.

    The files of the working folder are scratch: ``save`` hard-links them elsewhere. A file is never
    changed, as a saved memory may share it: a tile's next state gets another name.

    Args:
        empty: makes a tile's store without observations.
        budget: bytes; tiles in RAM may take the share CACHE of it.
        scratch: where the working folder is made; None: the system's folder for temporary files.

    Attributes:
        tiles: by number; None for a tile that was divided or joined.
        octree: the cubes that the tiles cover.
        places: tile and row of each segment of the memory.
        lock: held while tiles are read, written or moved.
        reserved: bytes of a tile that is being divided, so that its parts find room beside it.
    """

    def __init__(
        self, empty: Callable[[], Store], *, budget: int, scratch: Path | None = None
    ) -> None:
        self.empty, self.budget, self.scratch = empty, budget, scratch
        self.tiles: list[Tile | None] = []
        self.octree = Octree()
        self.places = SegmentPlaces()
        self.lock = threading.RLock()
        self._recent: OrderedDict[int, int] = OrderedDict()
        self._resident = 0
        self._folder: Path | None = None
        self._remove: Callable[[], object] = lambda: None
        self._writes = 0
        self.reserved = 0

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
    def largest(self) -> int:
        """Bytes above which a tile is divided."""
        return max(SMALLEST, int(LARGEST * self.budget))

    @property
    def resident(self) -> int:
        """Bytes that tiles take in RAM."""
        return self._resident

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

    def load(self, number: int) -> Store:
        """A tile's store, read into RAM if it is not there."""
        tile = self[number]
        if tile.store is None:
            tile.load(self.empty())
            self.touch(number)
            self.shrink(keep=number)
        assert tile.store is not None
        return tile.store

    def touch(self, number: int) -> None:
        """Note that a tile was used, and how many bytes it takes in RAM now."""
        self._resident += self[number].resident - self._recent.pop(number, 0)
        self._recent[number] = self[number].resident

    def shrink(self, *, keep: int = -1) -> None:
        """Write tiles to files, the least recently used first, until the others fit the budget.

        Args:
            keep: number of a tile that stays in RAM.
        """
        limit = CACHE * self.budget - self.reserved - self.places.nbytes
        for number in list(self._recent):
            if self._resident <= max(limit, 0):
                return
            if number != keep and self._recent[number]:
                self.evict(number)

    def evict(self, number: int) -> None:
        """Take a tile out of RAM; if it has changed, it is written first."""
        tile = self[number]
        if tile.dirty:
            self.write(number)
        tile.release()
        self._resident -= self._recent.pop(number, 0)

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
        self._resident -= self._recent.pop(number, 0)
        if tile.owned and tile.file is not None:
            tile.file.unlink(missing_ok=True)
        self.tiles[number] = None

    def tiles_of(
        self, positions: NDArray[np.float32], spacing: NDArray[np.float32], levels: VoxelLevels
    ) -> NDArray[np.int32]:
        """(N,) the number of the tile that each point belongs to; new tiles are made."""
        numbers, made = self.octree.tiles_of(positions, spacing, levels, free=len(self.tiles))
        for node in made:
            tile = Tile(node, store=self.empty())
            self.tiles.append(tile)
            self.touch(len(self.tiles) - 1)
        return numbers

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
        least = max(0, store.index.top - BLOCK_LEVEL)
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
            part = Tile(tuple(node), tile.segments[rows])
            part.store = part_of(store, rows, self.empty())
            part.changed()
            out.append(self.add(part))
            self.places.move(part.segments, out[-1], part.store.segments)
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
                if node != WHOLE and self._bytes(parts) < self.largest // 4
            ]
            if not small:
                return less
            for node, parts in small:
                self._join(node, [self.octree.leaves[part] for part in parts], parts)
                less += len(parts) - 1

    def _bytes(self, parts: Sequence[Node]) -> int:
        return sum(self[self.octree.leaves[part]].size for part in parts)

    def _join(
        self, node: Node, numbers: list[int],
        parts: list[Node],
    ) -> None:  # fmt: skip
        stores = [self.load(number) for number in numbers]
        tile = Tile(node, np.concatenate([self[number].segments for number in numbers]))
        tile.store = joined(stores, self.empty())
        tile.changed()
        self.octree.join(node, parts, len(self.tiles))
        number = self.add(tile)
        self.places.move(tile.segments, number, tile.store.segments)
        for old in numbers:
            self.drop(old)
        self.shrink(keep=number)


def part_levels(
    cells: NDArray[np.int64],
    weight: NDArray[np.float64],
    level: int,
    *,
    least: int,
    largest: float,
) -> tuple[NDArray[np.int64], list[Node]]:
    """Levels of the parts of a cube that is divided until each part is small enough.

    Args:
        cells: (S, 3) cell coordinates of the segments.
        weight: (S,) bytes of the segments.
        level: of the cube, 2**level cells wide.
        least: smallest level that a part may have.
        largest: bytes that a part may have.

    Returns:
        (S,) the level of each segment's part, and the cubes that were divided.
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
