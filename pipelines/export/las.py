"""Points as LAS 1.4, or LAZ by the file's suffix: point format 7, colours of 16 bits.

Coordinates are whole multiples of a step from an offset, so that a georeferenced scene keeps its
precision. Each point says how far it is trusted, which round it came with, whether a completer made
it (LAS's own flag "synthetic" says so, too) and whether it is of a scan.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gvtools.files import replaced_when_written
from pipelines.export.source import ExportOptions, Source, middle, points_summary

POINT_FORMAT, VERSION = 7, "1.4"
# Steps of coordinates in a voxel, at least, and the largest number of them.
STEPS_PER_VOXEL, MOST_STEPS = 10, 2**31 - 1
# 8 bits to 16: 255 becomes 65535.
TO_16_BITS = 257


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write one point a voxel."""
    import laspy

    memory = source.memory
    points = source.points(options)
    columns, rows = memory.columns, points.rows
    header = laspy.LasHeader(point_format=POINT_FORMAT, version=VERSION)
    header.generating_software = "gvtools"
    header.offsets = np.round(middle(points.positions))
    reach = float(np.abs(points.positions - header.offsets).max())
    # A power of ten, as other software writes it.
    step = 10.0 ** np.floor(np.log10(memory.voxel / STEPS_PER_VOXEL))
    while reach / step > MOST_STEPS:
        step *= 10
    header.scales = np.full(3, step)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("confidence", "f4", "sum over the views that saw it"),
            laspy.ExtraBytesParams("spacing", "f4", "footprint of a pixel, units"),
            laspy.ExtraBytesParams("round", "u2", "that it came with"),
            laspy.ExtraBytesParams("generated", "u1", "1: made by a completer"),
            laspy.ExtraBytesParams("scanned", "u1", "1: of a scan, no photograph"),
        ]
    )
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.positions.T
    cloud.red, cloud.green, cloud.blue = points.colors.astype(np.uint16).T * TO_16_BITS
    cloud.return_number[:] = cloud.number_of_returns[:] = 1
    cloud.synthetic[:] = columns.generated[rows]
    for name in ("confidence", "spacing", "round", "generated"):
        cloud[name] = getattr(columns, name)[rows]
    cloud["scanned"] = memory.scanned[rows]
    with replaced_when_written(path) as temporary, temporary.open("wb") as file:
        cloud.write(file, do_compress=path.suffix.lower() == ".laz")
    return f"{points_summary(points, memory)} in {path}, coordinates in steps of {step:g}"
