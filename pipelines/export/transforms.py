"""The cameras as ``transforms.json``."""

from __future__ import annotations

from pathlib import Path

from pipelines.export.cameras import foreign_transforms, write_transforms_export
from pipelines.export.source import ExportOptions, Source

IMAGES = "images"

foreign = foreign_transforms


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write the file, or into the folder; see ``pipelines.export.cameras``."""
    images = IMAGES if options.images is None else options.images
    written = write_transforms_export(source.memory, path, images=images, run=source.path)
    return f"{written.views} views ({written.generated} generated) in {path}"
