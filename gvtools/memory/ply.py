"""Memories as binary PLY: written for every viewer, read back as point clouds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError, OptionError
from gvtools.memory.store.store import Store
from gvtools.memory.thinning import thin
from gvtools.ply import read_ply, up_comment, write_ply

if TYPE_CHECKING:
    import open3d as o3d

    from gvtools.memory.store.tile import Tile


def read_point_cloud(path: Path) -> o3d.t.geometry.PointCloud:
    """A binary PLY as a point cloud in its own frame, read strictly."""
    from gvtools.o3d import o3d

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
    memory: Store,
    path: Path,
    *,
    max_points: int | None = None,
    observed: bool = False,
    up: NDArray[np.float64] | None = None,
) -> tuple[int, float]:
    """Write the observations with colour, confidence, spacing, round, view, generated and scanned.

    x, y, z are in the input's world frame: float, or double where the origin is so far away that
    float would lose a tenth of a voxel. ``max_points`` thins to one point per voxel (the most
    confident), of voxels as much larger than the memory's as it takes; None keeps every
    observation. A comment tells what is ``up`` (3,). Returns the points written, and the voxel edge
    they were thinned to (0 when all were kept).
    """
    comments = ("gvtools memory, input world frame, scene units", *up_comment(up))
    count = len(memory) - (memory.generated_count if observed else 0)
    if observed and not count:
        raise OptionError(f"{path}: the memory holds nothing that was observed")
    if max_points is not None and count > max_points:
        points = thin(memory, max_points, among=~memory.generated if observed else None)
        columns = {name: getattr(memory.columns, name)[points.rows] for name in _COLUMNS}
        kind = _vertex_type(memory, _reach(memory, columns["positions"]))
        write_ply(path, _vertices(memory, columns, kind), comments=comments)
        return len(points.rows), points.edge

    def columns_of(tile: Tile) -> dict[str, NDArray[Any]]:
        columns = {name: tile.column(name) for name in _COLUMNS}
        if observed:
            rows = ~memory.views.generated[columns["view"]]
            columns = {name: column[rows] for name, column in columns.items()}
        return columns

    box = memory.segments.rows()["box"]
    kind = _vertex_type(memory, _reach(memory, box[:, :6].reshape(-1, 3)))
    if kind["x"] == np.float64:
        # Corners of boxes may lie farther out than what these hold.
        tiles = memory.tiles.each()
        reach = max(_reach(memory, columns_of(tile)["positions"]) for tile in tiles)
        kind = _vertex_type(memory, reach)
    parts = (_vertices(memory, columns_of(tile), kind) for tile in memory.tiles.each())
    write_ply(path, np.empty(0, kind), more=parts, count=count, comments=comments)
    return count, 0.0


_COLUMNS = ("positions", "colors", "confidence", "spacing", "view")


def _reach(memory: Store, positions: NDArray[np.float32]) -> float:
    """The greatest coordinate in the world."""
    return float(np.abs(memory.frame.to_world(positions)).max(initial=0))


def _vertex_type(memory: Store, reach: float) -> np.dtype[np.void]:
    coordinate = "<f8" if reach * 2.0**-24 > 0.1 * memory.voxel else "<f4"
    return np.dtype(
        [("x", coordinate), ("y", coordinate), ("z", coordinate), ("red", "u1"), ("green", "u1"),
         ("blue", "u1"), ("confidence", "<f4"), ("spacing", "<f4"), ("round", "<i4"),
         ("view", "<i4"), ("generated", "u1"), ("scanned", "u1")],
    )  # fmt: skip


def _vertices(
    memory: Store, columns: Mapping[str, NDArray[Any]], kind: np.dtype[np.void]
) -> NDArray[np.void]:
    """Observations as vertices."""
    positions, view = memory.frame.to_world(columns["positions"]), columns["view"]
    vertices = np.empty(len(positions), kind)
    for k, (axis, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertices[axis] = positions[:, k]
        vertices[color] = columns["colors"][:, k]
    for name in ("confidence", "spacing", "view"):
        vertices[name] = columns[name]
    for name in ("round", "generated", "scanned"):
        vertices[name] = getattr(memory.views, name)[view]
    return vertices
