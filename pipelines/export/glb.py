"""A memory as a glTF binary point cloud.

Positions are float32 around the middle of the cloud; the node's matrix moves them to the input's
world frame, so that a georeferenced scene keeps its precision in readers that compute matrices in
double. Axes are the input's: glTF calls y up, an input's up is its own affair, and a turned cloud
would no longer lie on the other exports. The node's extras tell both.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from gvtools.errors import OptionError
from gvtools.files import replaced_when_written
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.thinning import thinned

NODE = "gvtools_memory"
FRAME = "input world frame, scene units, axes as in the input (not turned to y up)"


def write_glb(
    memory: SpatialMemory, path: Path, *, max_points: int | None = None
) -> tuple[int, float]:
    """Write one point a voxel with its colour.

    Args:
        memory: with at least one observation.
        path: the file.
        max_points: thin to at most so many.

    Returns:
        Points written, and the voxel edge they were thinned to, scene units.

    Raises:
        OptionError: trimesh is not installed.
        ProjectError: the file cannot be written.
    """
    try:
        import trimesh
    except ImportError:
        raise OptionError(
            "--format glb needs trimesh, which is not installed; install it with "
            "'pip install gvtools[glb]', or export ply"
        ) from None
    kept = thinned(memory, max_points)
    positions = memory.positions[kept.rows]
    middle = (positions.min(axis=0) + positions.max(axis=0)) / 2
    cloud = trimesh.PointCloud(
        (positions - middle).astype(np.float32), colors=memory.columns.colors[kept.rows]
    )
    move = np.eye(4)
    move[:3, 3] = middle
    scene = trimesh.Scene()
    scene.add_geometry(
        cloud,
        node_name=NODE,
        geom_name=NODE,
        transform=move,
        metadata={"origin": middle.tolist(), "frame": FRAME, "voxel": kept.edge},
    )
    buffer = io.BytesIO(scene.export(file_type="glb"))
    with replaced_when_written(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())
    return len(kept.rows), kept.edge
