"""A memory as a glTF binary point cloud.

Positions are float32 around the middle of the cloud; the node's matrix moves them to the input's
world frame, so that a georeferenced scene keeps its precision in readers that compute matrices in
double. Axes are the input's: glTF calls y up, an input's up is its own affair, and a turned cloud
would no longer lie on the other exports. The node's extras tell both.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.files import replaced_when_written
from pipelines.export.source import ExportOptions, Source, middle, points_summary

# Web viewers are slow beyond it.
MAX_POINTS = 2_000_000
NODE = "gvtools_memory"
FRAME = "input world frame, scene units, axes as in the input (not turned to y up)"


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write one point a voxel with its colour."""
    import trimesh

    points = source.points(options, most=MAX_POINTS)
    write_scene(
        lambda positions: trimesh.PointCloud(positions, colors=points.colors),
        points.positions,
        path,
        node=NODE,
        extras={"voxel": points.edge},
    )
    return f"{points_summary(points, source.memory)} in {path}, in the input's axes"


def write_scene(
    geometry: Callable[[NDArray[np.float32]], Any],
    positions: NDArray[np.float64],
    path: Path,
    *,
    node: str,
    extras: Mapping[str, Any] | None = None,
) -> None:
    """Write a scene of one node.

    Args:
        geometry: makes trimesh's geometry of positions (N, 3) around the node's origin.
        positions: (N, 3) world frame, scene units.
        path: the file.
        node: its name.
        extras: what the node says beside its origin and frame.
    """
    import trimesh

    center = middle(positions)
    move = np.eye(4)
    move[:3, 3] = center
    scene = trimesh.Scene()
    scene.add_geometry(
        geometry((positions - center).astype(np.float32)),
        node_name=node,
        geom_name=node,
        transform=move,
        metadata={"origin": center.tolist(), "frame": FRAME, **(extras or {})},
    )
    buffer = io.BytesIO(scene.export(file_type="glb"))
    with replaced_when_written(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())
