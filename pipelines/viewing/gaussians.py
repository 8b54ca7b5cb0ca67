"""The Gaussians that viewers draw of a run: those of its export as splats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.export.source import ExportOptions, Source
from pipelines.export.splats import Splats, splats_of
from viz.run_view.gaussians import ShownGaussians

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory


def run_gaussians(path: Path, memory: SpatialMemory, most: int) -> ShownGaussians:
    """A run's fitted Gaussians, and those of its points.

    Args:
        path: a run's folder, or a memory file.
        memory: what it holds.
        most: of points at most; fitted Gaussians are always whole.
    """
    source = Source(path, memory)
    fitted = 0 if source.appearance is None else len(source.appearance.gaussians)
    return shown_gaussians(splats_of(source, ExportOptions(max_points=fitted + most)))


def shown_gaussians(splats: Splats) -> ShownGaussians:
    """An export's Gaussians as viewers have them."""
    return ShownGaussians(splats.values, splats.origin, splats.rounds)
