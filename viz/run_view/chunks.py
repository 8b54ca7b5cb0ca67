"""Parts of space, so that a viewer draws those near its camera finely and the others coarsely."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from viz.run_view.detail import coordinates

if TYPE_CHECKING:
    from gvtools.cameras import Cameras
    from gvtools.memory.spatial_memory import SpatialMemory

# Observations that the cuts are found from, and those that are looked at in one go.
SAMPLED, AT_ONCE = 200_000, 1_000_000
# Percent of the points at each end that do not tell how far a part reaches.
STRAY = 5
# A page is slow to open with more; there is one a chunk and round.
MOST_NODES = 4096


@dataclass(frozen=True, eq=False)
class Chunks:
    """Space cut in two again and again, so that all parts hold about as much: a k-d tree.

    Attributes:
        axes: (C - 1,) int8, the axis of the memory's frame that each cut is across; the halves of
            cut k are cut by 2k + 1 (lower) and 2k + 2; C is a power of two.
        cuts: (C - 1,) float64, where.
        held: how many observations there were.
    """

    axes: NDArray[np.int8]
    cuts: NDArray[np.float64]
    held: int

    @classmethod
    def of(cls, memory: SpatialMemory, size: int, *, cell: float) -> Chunks:
        """Divide a memory.

        Args:
            memory: may be empty.
            size: observations of a chunk at most, about; more where there would be too many chunks.
            cell: edge of cells (see cell_keys) of which none is cut, scene units.
        """
        count = len(memory)
        most = (MOST_NODES // max(1, len(memory.rounds))).bit_length() - 1
        levels = min(max(0, most), max(0, -(-count // size) - 1).bit_length())
        sampled = slice(0, count, max(1, count // SAMPLED))
        position = np.stack([axis[sampled] for axis in coordinates(memory)], axis=1)
        axes = np.zeros(2**levels - 1, np.int8)
        cuts = np.zeros(2**levels - 1)
        parts = {0: position}
        for k in range(len(cuts)):
            part = parts.pop(k)
            if len(part):
                low, high = np.percentile(part, (STRAY, 100 - STRAY), axis=0)
                axes[k] = np.argmax(high - low)
                cuts[k] = _middle(part[:, axes[k]], cell)
            above = part[:, axes[k]] >= cuts[k]
            parts[2 * k + 1], parts[2 * k + 2] = part[~above], part[above]
        return cls(axes, cuts, count)

    def __len__(self) -> int:
        """How many there are."""
        return len(self.cuts) + 1

    def number(self, memory: SpatialMemory, rows: NDArray[np.int64] | slice) -> NDArray[np.uint16]:
        """(P,) uint16, the chunk of each of some observations."""
        position = [axis[rows] for axis in coordinates(memory)]
        at = np.zeros(len(position[0]), np.int64)
        for _ in range(len(self).bit_length() - 1):
            above = np.choose(self.axes[at], position) >= self.cuts[at]
            at = 2 * at + 1 + above
        return (at - len(self.cuts)).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class ChunkRows:
    """The observations of a memory, chunk by chunk.

    Attributes:
        starts: (C + 1,) int64, where in the list of all observations each chunk's begin.
        boxes: (C, 2, 3) float32, least and greatest coordinates in the memory's frame; 0 where a
            chunk is empty.
    """

    starts: NDArray[np.int64]
    boxes: NDArray[np.float32]
    _rows: NDArray[np.int32]

    @classmethod
    def of(cls, memory: SpatialMemory, chunks: Chunks) -> ChunkRows:
        """Sort a memory's observations."""
        count = len(memory)
        number = np.empty(count, np.uint16)
        for first in range(0, count, AT_ONCE):
            part = slice(first, min(first + AT_ONCE, count))
            number[part] = chunks.number(memory, part)
        rows = np.argsort(number, kind="stable").astype(np.int32)
        held = np.bincount(number, minlength=len(chunks))
        starts = np.concatenate([[0], np.cumsum(held)])
        boxes = np.zeros((len(chunks), 2, 3), np.float32)
        filled = np.flatnonzero(held)
        if filled.size:
            for k, axis in enumerate(coordinates(memory)):
                sorted_ = axis[rows]
                boxes[filled, 0, k] = np.minimum.reduceat(sorted_, starts[filled])
                boxes[filled, 1, k] = np.maximum.reduceat(sorted_, starts[filled])
        return cls(starts, boxes, rows)

    def rows(self, chunk: int) -> NDArray[np.int64]:
        """(P,) int64, ascending: the observations of a chunk."""
        return self._rows[self.starts[chunk] : self.starts[chunk + 1]].astype(np.int64)

    def near(self, camera: Cameras, *, reach: float, budget: int) -> list[int]:
        """The chunks next to a camera that its frustum touches, as long as the budget lasts.

        Args:
            camera: a batch of one, with the memory's frame in the place of the world's.
            reach: chunks farther away than this are left out, scene units.
            budget: observations in all of them at most.

        Returns:
            Nearest first.
        """
        K, pose = camera.K[0], camera.cam_from_world[0]
        width, height = float(camera.width[0]), float(camera.height[0])
        # Rows n with n p >= 0 for all p inside, camera frame: x >= 0, x <= width, and so on.
        last = np.array([0.0, 0.0, 1.0])
        planes = np.stack([K[0], width * last - K[0], K[1], height * last - K[1], last])
        normals, offsets = planes @ pose[:3, :3], planes @ pose[:3, 3]
        low, high = self.boxes[:, 0].astype(np.float64), self.boxes[:, 1].astype(np.float64)
        middle, half = (low + high) / 2, (high - low) / 2
        # Of each box the corner farthest inside.
        seen = (middle @ normals.T + half @ np.abs(normals.T) + offsets >= 0).all(axis=1)
        center = -pose[:3, :3].T @ pose[:3, 3]
        away = np.linalg.norm(np.maximum(0, np.maximum(low - center, center - high)), axis=1)
        held = np.diff(self.starts)
        order = np.argsort(away, kind="stable")
        order = order[(seen & (away <= reach) & (held > 0))[order]]
        chosen: list[int] = order[np.cumsum(held[order]) <= budget].tolist()
        return chosen


def _middle(values: NDArray[np.float32], cell: float) -> float:
    """Between two cells, so that about half of the values lie on each side."""
    below = float(np.floor(np.median(values) / cell) * cell)
    return min(below, below + cell, key=lambda cut: abs(float((values >= cut).mean()) - 0.5))
