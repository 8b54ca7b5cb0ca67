"""A memory made from any coloured PLY point cloud, so that it can be projected like one's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import MemoryFileError
from gvtools.memory.io.ply import read_ply
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.store.points import PointSet
from gvtools.memory.store.voxel_index import rounded_origin

# Nearest neighbours are looked up for this many points when the file gives no spacing.
SAMPLED = 20_000


def memory_from_ply(path: Path) -> SpatialMemory:
    """Read a binary PLY as a memory.

    A PLY does not tell from where its points were seen, so all observed points count as one view,
    and all points with ``generated`` as another. ``confidence`` and ``spacing`` are used where the
    file has them; otherwise confidence is 1 and spacing the median distance between neighbours,
    which is also the voxel edge.

    Raises:
        MemoryFileError: truncated, damaged, without colours, without two distinct points, or
            without a point whose confidence and spacing are positive.
    """
    vertices = read_ply(path)
    names = vertices.dtype.names or ()
    if not {"red", "green", "blue"} <= set(names) or vertices["red"].dtype != np.uint8:
        raise MemoryFileError(f"{path}: no uchar red, green, blue; expected a coloured point cloud")
    positions = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    finite = np.isfinite(positions).all(axis=1)
    vertices, positions = vertices[finite], positions[finite]
    distance = _neighbour_distance(positions) if len(positions) > 1 else 0.0
    if not distance > 0:
        raise MemoryFileError(f"{path}: {len(positions)} distinct points; expected at least two")
    count = len(positions)
    spacing = (
        vertices["spacing"].astype(np.float32)
        if "spacing" in names
        else np.full(count, distance, np.float32)
    )
    confidence = (
        vertices["confidence"].astype(np.float32)
        if "confidence" in names
        else np.ones(count, np.float32)
    )
    generated = vertices["generated"] != 0 if "generated" in names else np.zeros(count, np.bool_)
    origin = rounded_origin(positions.mean(axis=0), distance)
    # Points of one file were seen together as finely as they lie.
    memory = SpatialMemory(distance, origin=origin, options=MemoryOptions(footprints=0.0))
    # Where the points were seen from is unknown; a camera in their midst stands for it.
    pose = np.eye(4)
    pose[:3, 3] = -positions.mean(axis=0)
    camera = Cameras(np.eye(3)[None], pose[None], np.array([1]), np.array([1]), (path.name,))
    colors = np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=1)
    for made in (False, True):
        rows = generated == made
        if rows.any():
            points = PointSet(
                (positions[rows] - origin).astype(np.float32),
                np.ascontiguousarray(colors[rows]),
                confidence[rows],
                spacing[rows],
                camera,
                memory.frame,
                None,
                {},
            )
            memory.fuse(points, round=int(made), generated=made)
    if not len(memory):
        raise MemoryFileError(
            f"{path}: none of its {count} points has a positive, finite confidence and spacing"
        )
    return memory


def _neighbour_distance(positions: NDArray[np.float64]) -> float:
    from scipy.spatial import cKDTree

    tree = cKDTree(positions)
    sample = positions[:: max(1, len(positions) // SAMPLED)]
    distance, _ = tree.query(sample, k=2)
    apart = distance[:, 1][distance[:, 1] > 0]
    return float(np.median(apart)) if apart.size else 0.0
