"""Memories as binary PLY: written for every viewer, read back as point clouds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError, OptionError
from gvtools.memory.store.store import Store
from gvtools.memory.thinning import thinned
from gvtools.ply import read_ply, write_ply

if TYPE_CHECKING:
    import open3d as o3d

    from gvtools.memory.tiles.tile import Tile


def read_point_cloud(path: Path) -> o3d.t.geometry.PointCloud:
    """A binary PLY as a point cloud in its own frame, read strictly."""
    import open3d as o3d

    vertices = read_ply(path)
    names = vertices.dtype.names or ()
    if not {"red", "green", "blue"} <= set(names) or vertices["red"].dtype != np.uint8:
        raise MemoryFileError(f"{path}: no uchar red, green, blue; expected a coloured point cloud")
    tensor = o3d.core.Tensor
    cloud = o3d.t.geometry.PointCloud()
    cloud.point.positions = tensor(np.stack([vertices[k].astype(np.float64) for k in "xyz"], 1))
    cloud.point.colors = tensor(np.stack([vertices[k] for k in ("red", "green", "blue")], 1))
    for name in ("confidence", "spacing", "round", "view", "generated", "scanned"):
        if name in names:
            cloud.point[name] = tensor(vertices[name][:, None].copy())
    return cloud


def export_memory_ply(
    memory: Store, path: Path, *, max_points: int | None = None, observed: bool = False
) -> tuple[int, float]:
    """Write the observations with colour, confidence, spacing, round, view, generated and scanned.

    x, y, z are in the input's world frame: float, or double where the origin is so far away that
    float would lose a tenth of a voxel.

    Args:
        memory: what to write.
        path: the PLY.
        max_points: thin to at most so many points: one per voxel (the most confident), of voxels
            as much larger than the memory's as it takes; None keeps every observation.
        observed: leave out what a completer made.

    Returns:
        Points written, and the voxel edge they were thinned to (0 when all were kept).
    """
    if memory.tiles is not None and max_points is None:
        return _export_tiles(memory, path, observed=observed), 0.0
    among = ~memory.generated if observed else np.ones(len(memory), np.bool_)
    rows, edge = np.flatnonzero(among), 0.0
    if observed and not len(rows):
        raise OptionError(f"{path}: the memory holds nothing that was observed")
    if max_points is not None and len(rows) > max_points:
        thin = thinned(memory, max_points, among=among)
        rows, edge = thin.rows, thin.edge
    reach = float(np.abs(memory.positions[rows]).max(initial=0))
    columns = {name: getattr(memory.columns, name)[rows] for name in _COLUMNS}
    vertices = _vertices(memory, columns, reach=reach)
    write_ply(path, vertices, comments=_COMMENTS)
    return len(rows), edge


_COLUMNS = ("positions", "colors", "confidence", "spacing", "round", "view", "generated")
_COMMENTS = ("gvtools memory, input world frame, scene units",)


def _vertices(
    memory: Store, columns: Mapping[str, NDArray[Any]], *, reach: float
) -> NDArray[np.void]:
    """Observations as vertices; ``reach`` is the greatest coordinate of all."""
    coordinate = "<f8" if reach * 2.0**-24 > 0.1 * memory.voxel else "<f4"
    positions = memory.frame.to_world(columns["positions"])
    vertices = np.empty(
        len(positions),
        [("x", coordinate), ("y", coordinate), ("z", coordinate), ("red", "u1"), ("green", "u1"),
         ("blue", "u1"), ("confidence", "<f4"), ("spacing", "<f4"), ("round", "<i4"),
         ("view", "<i4"), ("generated", "u1"), ("scanned", "u1")],
    )  # fmt: skip
    for k, (axis, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertices[axis] = positions[:, k]
        vertices[color] = columns["colors"][:, k]
    for name in _COLUMNS[2:]:
        vertices[name] = columns[name]
    vertices["scanned"] = memory.views.scanned[columns["view"]]
    return vertices


def _export_tiles(memory: Store, path: Path, *, observed: bool) -> int:
    """Write the observations tile by tile; returns how many."""
    tiles, segments, n = memory.tiles, memory.segments, memory.segments.count
    assert tiles is not None
    box = segments.box[:n]
    corners = np.concatenate([box[:, :3], box[:, 3:6]])
    reach = float(np.abs(memory.frame.to_world(corners)).max(initial=0))
    count = len(memory) - (memory.generated_count if observed else 0)
    if not count:
        raise OptionError(f"{path}: the memory holds nothing that was observed")

    def part(tile: Tile) -> NDArray[np.void]:
        columns = {name: tile.column(name) for name in (*_COLUMNS[:4], "view")}
        view = columns["view"]
        columns["round"], made = memory.views.round[view], memory.views.generated[view]
        columns["generated"] = made
        if observed:
            columns = {name: column[~made] for name, column in columns.items()}
        return _vertices(memory, columns, reach=reach)

    none = {name: np.empty((0, 3) if name in _COLUMNS[:2] else 0, int) for name in _COLUMNS}
    write_ply(
        path, _vertices(memory, none, reach=reach), count=count, comments=_COMMENTS,
        more=(part(tile) for tile in tiles.each()),
    )  # fmt: skip
    return count
