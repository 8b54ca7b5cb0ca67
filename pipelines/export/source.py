"""What an export is made from, and the options that choose from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.memory.thinning import thinned
from gvtools.runs.memory_file import load_appearance

if TYPE_CHECKING:
    from gvtools.appearance.appearance import Appearance
    from gvtools.memory.spatial_memory import SpatialMemory


@dataclass(frozen=True)
class ExportOptions:
    """What a user asked for; None: was not given, the format has its own default.

    Attributes:
        max_points: thin to at most so many points.
        observed: leave out what a completer made.
        images: folder of the observed views' pictures, for ``transforms``.
        method: that makes a mesh, ``tsdf`` or ``poisson``.
        voxel: edge of the voxels that a mesh is made in, scene units.
        max_triangles: simplify a mesh to at most so many.
        texture: side of the picture that a mesh's colours are in, texels.
    """

    max_points: int | None = None
    observed: bool | None = None
    images: str | None = None
    method: str | None = None
    voxel: float | None = None
    max_triangles: int | None = None
    texture: int | None = None


@dataclass(frozen=True, eq=False)
class Points:
    """Points of a memory, one a voxel.

    Attributes:
        rows: (P,) their observations in the memory.
        positions: (P, 3) float64, world frame, scene units.
        colors: (P, 3) uint8.
        edge: of the voxels that they were thinned to, scene units.
    """

    rows: NDArray[np.int64]
    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    edge: float


@dataclass(frozen=True, eq=False)
class Source:
    """A run, or a memory alone.

    Attributes:
        path: a run's folder, or a memory file.
        memory: with at least one observation.
        up_to: round that the memory ends with; None for the last one.
    """

    path: Path
    memory: SpatialMemory
    up_to: int | None = None

    @cached_property
    def appearance(self) -> Appearance | None:
        """The Gaussians that the run fitted; None where it has none."""
        return load_appearance(self.path)

    def points(
        self,
        options: ExportOptions,
        *,
        most: int | None = None,
        among: NDArray[np.bool_] | None = None,
    ) -> Points:
        """The most confident observation of each voxel.

        Args:
            options: ``max_points`` and ``observed`` count.
            most: points at most where the user gave no number.
            among: (N,) the observations that count; None for all.
        """
        memory = self.memory
        chosen = np.ones(len(memory), np.bool_) if among is None else among
        if options.observed:
            chosen = chosen & ~memory.generated
        if not chosen.any():
            raise OptionError(f"--observed: nothing in {self.path} was observed; leave it out")
        limit = most if options.max_points is None else options.max_points
        kept = thinned(memory, limit, among=chosen)
        columns = memory.columns
        positions = memory.frame.to_world(columns.positions[kept.rows])
        return Points(kept.rows, positions, columns.colors[kept.rows], kept.edge)


def middle(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) the middle of the box around positions (N, 3)."""
    return (positions.min(axis=0) + positions.max(axis=0)) / 2


def points_summary(points: Points, memory: SpatialMemory) -> str:
    """How many points there are, for the user."""
    return f"{len(points.rows)} points of {len(memory)} observations (voxels of {points.edge:.4g})"
