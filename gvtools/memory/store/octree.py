"""An octree of tiles' cubes over cells that are 128 finest voxels wide.

The widest voxel is one cell wide, so a voxel of any level lies in one tile, and each tile can be
fused by itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.store.voxel_index import (
    COORDINATE_BITS,
    EMPTY_KEY,
    VoxelIndex,
    VoxelLevels,
    voxel_keys,
)

# Cells are the blocks of voxels of this level: 16 voxels, each 8 finest voxels wide.
CELL_LEVEL = 3
# Level of the cube of all cells.
ROOT = COORDINATE_BITS
_MASK = (1 << COORDINATE_BITS) - 1
# Key of points beyond all cells; only the widest voxels reach there. They share the tile FAR.
FAR_KEY = np.int64(1 << 62)
# A cube: its level (edge of 2**level cells) and its coordinates in such edges.
Node = tuple[int, int, int, int]
FAR: Node = (ROOT + 1, 0, 0, 0)
WHOLE: Node = (ROOT, 0, 0, 0)


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
