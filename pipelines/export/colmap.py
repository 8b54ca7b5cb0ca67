"""A COLMAP model of the cameras and points."""

from __future__ import annotations

from pathlib import Path

from pipelines.export.cameras import foreign_model, write_colmap_export
from pipelines.export.source import ExportOptions, Source

# COLMAP's own tools give up on more.
MAX_POINTS = 200_000

foreign = foreign_model


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write ``sparse/0`` below a folder; see ``pipelines.export.cameras``."""
    limit = MAX_POINTS if options.max_points is None else options.max_points
    written = write_colmap_export(source.memory, path, max_points=limit, run=source.path)
    return (
        f"{written.views} views ({written.generated} generated), {written.points} points of "
        f"{len(source.memory)} observations (voxels of {written.edge:.4g}), {written.elements} "
        f"track elements in {path}/sparse/0; no pictures are copied"
    )
