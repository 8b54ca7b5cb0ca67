"""Voxels as wide as what they hold: far surfaces are stored as coarsely as they were seen.

Edges double from level to level, so that a voxel of one level holds eight of the level before it.
"""

# mypy: no-check-untyped-defs

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled
from gvtools.memory.store.voxel_index import MOST_LEVEL

# Footprints this much short of a level's belong to it: the ratios of depths are often whole
# numbers, and rounding must not tell to which level a surface goes.
SLACK = 2.0**-10


@dataclass(frozen=True)
class VoxelLevels:
    """Which voxels hold what was seen how finely.

    Attributes:
        edge: of the finest voxels, scene units.
        voxels_per_footprint: voxels are at most so many footprints of what they hold wide, or the
            finest there are; 0 for the finest alone.
    """

    edge: float
    voxels_per_footprint: float = 0.0

    @property
    def per_spacing(self) -> float:
        """What spacings are multiplied with to tell their level, see ``level_of``."""
        return self.voxels_per_footprint / self.edge * (1 + SLACK)

    def of(self, spacing: NDArray[np.float32]) -> NDArray[np.uint8]:
        """(N,) levels of points by their spacing (N,)."""
        levels = np.empty(len(spacing), np.uint8)
        _levels(spacing, self.per_spacing, levels)
        return levels


def levels_above(level: NDArray[np.uint8], edges: float) -> NDArray[np.int64]:
    """By how many doublings voxels are wider than cells; 0 where they are not.

    Args:
        level: (N,) of the voxels.
        edges: width of a cell in finest edges.
    """
    return np.maximum(level.astype(np.int64) - int(np.floor(np.log2(max(edges, 1.0)))), 0)


@compiled(inline="always")
def level_of(spacing, per_spacing):
    """The level of a spacing: 0 below twice the finest edge, 1 below four times, and so on."""
    ratio = spacing * per_spacing
    level = 0
    while ratio >= 2 and level < MOST_LEVEL:
        ratio *= 0.5
        level += 1
    return level


@compiled()
def _levels(spacing, per_spacing, levels):
    for i in range(len(spacing)):
        levels[i] = level_of(np.float64(spacing[i]), per_spacing)
