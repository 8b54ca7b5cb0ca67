"""The memory's observations with all that is known of each, as PLY."""

from __future__ import annotations

from pathlib import Path

from gvtools.memory.io.ply import export_memory_ply
from pipelines.export.source import ExportOptions, Source


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write every observation, or one a voxel where a number of points is given."""
    memory = source.memory
    observed = bool(options.observed)
    points, edge = export_memory_ply(memory, path, max_points=options.max_points, observed=observed)
    thinned = f", thinned to voxels of {edge:.4g}" if edge else ""
    return f"{points} of {len(memory)} observations{thinned} in {path}"
