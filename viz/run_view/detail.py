"""Level of detail: which observations a viewer draws when there are more than it can hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from viz.run_view.view import RunView


# Three of them, and a bit for the source, fit a signed 64-bit key.
AXIS_BITS = 20


@dataclass(frozen=True, eq=False)
class Detail:
    """The observations to draw.

    Attributes:
        rows: (P,) int64, ascending.
        edge: of the cells that were thinned to, scene units; 0 when nothing was left out.
        size: edge of the square to draw a point as, scene units.
    """

    rows: NDArray[np.int64]
    edge: float
    size: float


def detail(memory: SpatialMemory, budget: int) -> Detail:
    """At most ``budget`` observations, spread evenly in space.

    Of each cell the first observation is taken, one of each source: so a later round never changes
    what is drawn of earlier ones, unless cells have to grow, and generated content stays visible
    beside observed content. Cells grow from the memory's voxels.

    Args:
        memory: may be empty.
        budget: at least 1.
    """
    count = len(memory)
    spacing = memory.columns.spacing[:count][:: max(1, count // 100_000)]
    size = float(np.median(spacing)) if count else memory.voxel
    if count <= budget:
        return Detail(np.arange(count), 0.0, size)
    positions = memory.columns.positions
    reach = float(np.abs(positions).max())
    edge = max(memory.voxel, reach / 2 ** (AXIS_BITS - 2))
    while True:
        keys = (_cell_keys(positions, edge) << 2) | memory.generated | (memory.scanned << 1)
        _, first = np.unique(keys, return_index=True)
        # Cells that meet at the origin do not become one however large they are.
        if len(first) <= budget or edge > reach:
            return Detail(np.sort(first)[:budget], edge, max(size, edge))
        edge *= max(1.1, float(np.sqrt(len(first) / budget)))


def point_pixels(focal: float, drawn: Detail, run: RunView) -> float:
    """How wide to draw points where all have one size, pixels: as wide as they are at mid depth."""
    return float(np.clip(1.2 * focal * drawn.size / run.typical_depth, 2.0, 8.0))


def _cell_keys(positions: NDArray[np.float32], edge: float) -> NDArray[np.int64]:
    """(N,) int64 below 2⁶⁰, equal for positions (N, 3) of one cell."""
    keys = np.zeros(len(positions), np.int64)
    for axis in positions.T:
        # Times the inverse, as the memory counts its voxels.
        cell = np.floor(axis * (1.0 / np.float64(edge))).astype(np.int64)
        keys = (keys << AXIS_BITS) | (cell - cell.min())
    return keys
