"""Where the segments of a memory's table lie in its tiles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.store.columns import Segments
from gvtools.memory.store.voxel_index import extended


class SegmentPlaces:
    """For each segment its tile, its place there, and the level of its voxels.

    Attributes:
        count: rows in use.
        tile: (S,) int32, number of the tile.
        local: (S,) int32, its row in the tile's own table.
        row: (S,) int64, its first observation in the tile.
        level: (S,) uint8.
    """

    ARRAYS = ("tile", "local", "row", "level")

    def __init__(self) -> None:
        self.count = 0
        self.tile: NDArray[np.int32] = np.empty(0, np.int32)
        self.local: NDArray[np.int32] = np.empty(0, np.int32)
        self.row: NDArray[np.int64] = np.empty(0, np.int64)
        self.level: NDArray[np.uint8] = np.empty(0, np.uint8)

    def append(
        self,
        tile: NDArray[np.int32],
        local: NDArray[np.int32],
        row: NDArray[np.int64],
        *,
        level: NDArray[np.uint8],
    ) -> None:
        """Add rows of equal number."""
        need = self.count + len(tile)
        if need > len(self.tile):
            size = max(need, 2 * len(self.tile))
            for name in self.ARRAYS:
                setattr(self, name, extended(getattr(self, name), size, self.count))
        for name, rows in zip(self.ARRAYS, (tile, local, row, level), strict=True):
            getattr(self, name)[self.count : need] = rows
        self.count = need

    def move(self, which: NDArray[np.int32], tile: int, segments: Segments) -> None:
        """Segments ``which`` are now all those of a tile, in this order."""
        self.tile[which] = tile
        self.local[which] = np.arange(len(which), dtype=np.int32)
        self.row[which] = segments.start[: segments.count]

    def select(self, keep: NDArray[np.bool_]) -> None:
        """Keep some rows, in their order."""
        for name in self.ARRAYS:
            setattr(self, name, getattr(self, name)[: self.count][keep])
        self.count = len(self.tile)

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use."""
        return sum(getattr(self, name)[: self.count].nbytes for name in self.ARRAYS)
