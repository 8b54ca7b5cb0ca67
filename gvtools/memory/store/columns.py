"""The memory's arrays: observations, and the runs that culling works on."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.store.voxel_index import extended


@dataclass(eq=False)
class Records:
    """Observations as parallel arrays with spare capacity; only the first ``count`` rows count.

    Attributes:
        x, y, z: (C,) float32 each, scene units, relative to the memory's origin; apart, because
            vector units want them so.
        color: (C, 3) uint8.
        confidence: (C,) float32, from the views of the observation's own round.
        spacing: (C,) float32, scene units.
        view: (C,) int32, row of the view table.
        level: (C,) uint8, of its voxel.
        next: (C,) int32, the next observation of the same voxel, -1 at the end.
        agreement: (C,) float32, confidence added by later rounds.
    """

    count: int = 0
    x: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    y: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    z: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    color: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), np.uint8))
    confidence: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    spacing: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    view: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    level: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    next: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    agreement: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))

    ARRAYS = ("x", "y", "z", "color", "confidence", "spacing", "view", "level", "next",
              "agreement")  # fmt: skip

    def reserve(self, extra: int) -> None:
        """Make room for ``extra`` more rows, doubling the capacity."""
        need = self.count + extra
        capacity = len(self.confidence)
        if need > capacity:
            size = max(need, 2 * capacity)
            for name in self.ARRAYS:
                setattr(self, name, extended(getattr(self, name), size, self.count))

    def agree(self, rows: NDArray[np.int32], weights: NDArray[np.float32]) -> None:
        """Add to the agreement of ``rows``; a sum past float32 is infinite until it is capped."""
        with np.errstate(over="ignore"):
            np.add.at(self.agreement, rows, weights)

    @property
    def position(self) -> NDArray[np.float32]:
        """(N, 3) float32, a copy of x, y, z."""
        n = self.count
        return np.stack([self.x[:n], self.y[:n], self.z[:n]], axis=1)

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use."""
        return sum(getattr(self, name)[: self.count].nbytes for name in self.ARRAYS)


@dataclass(eq=False)
class Runs:
    """Contiguous observations of one block and one view: the unit of culling.

    Attributes:
        count: rows in use.
        start: (C,) int64, first observation.
        length: (C,) int32, observations.
        view: (C,) int32, row of the view table.
        box: (C, 7) float32, scene units: bounding box of the positions (min xyz, max xyz) and the
            largest spacing.
        groups: rows of ``group_box`` in use.
        group_box: (D, 7) float32, the box around each GROUP consecutive runs.
    """

    count: int = 0
    start: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    length: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    view: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    box: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 7), np.float32))
    groups: int = 0
    group_box: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 7), np.float32))

    ARRAYS = ("start", "length", "view", "box")

    # Consecutive runs lie near each other; culling asks groups of this many first.
    GROUP = 32

    def append(
        self,
        start: NDArray[np.int64],
        length: NDArray[np.int32],
        view: NDArray[np.int32],
        box: NDArray[np.float32],
        *,
        changed: int | None = None,
    ) -> None:
        """Add rows of equal number; ``changed`` is the first earlier run whose box grew."""
        need = self.count + len(start)
        if need > len(self.start):
            size = max(need, 2 * len(self.start))
            for name in self.ARRAYS:
                setattr(self, name, extended(getattr(self, name), size, self.count))
        for name, rows in zip(self.ARRAYS, (start, length, view, box), strict=True):
            getattr(self, name)[self.count : need] = rows
        first = min(self.count if changed is None else changed, self.count) // self.GROUP
        self.count = need
        self._box_groups(first)

    def _box_groups(self, first: int) -> None:
        """Bring the groups' boxes from group ``first`` on up to date."""
        groups = -(-self.count // self.GROUP)
        if groups > len(self.group_box):
            self.group_box = extended(self.group_box, max(groups, 2 * len(self.group_box)), first)
        self.groups = groups
        box = self.box[first * self.GROUP : self.count]
        if len(box):
            starts = np.arange(0, len(box), self.GROUP)
            rows = self.group_box[first:groups]
            rows[:, :3] = np.minimum.reduceat(box[:, :3], starts)
            rows[:, 3:] = np.maximum.reduceat(box[:, 3:], starts)

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use."""
        rows = sum(getattr(self, name)[: self.count].nbytes for name in self.ARRAYS)
        return rows + self.group_box[: self.groups].nbytes
