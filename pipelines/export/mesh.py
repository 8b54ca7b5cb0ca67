"""A mesh with vertex colours, as PLY, glTF binary or OBJ, in the input's world frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.files import replaced_when_written, write_text
from gvtools.memory.store.local_frame import LocalFrame
from pipelines.export.glb import write_scene
from pipelines.export.simplify import simplified
from pipelines.export.source import ExportOptions, Source
from pipelines.export.surfaces import mesh_voxel, poisson_mesh, tsdf_mesh

if TYPE_CHECKING:
    import open3d as o3d

METHODS = {"tsdf": tsdf_mesh, "poisson": poisson_mesh}
NODE = "gvtools_mesh"


@dataclass(frozen=True, eq=False)
class Triangles:
    """A mesh as files hold it.

    Attributes:
        vertices: (V, 3) float64, world frame, scene units.
        faces: (F, 3) int32, rows of ``vertices``, against the clock as seen from outside.
        colors: (V, 3) uint8.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8]

    @classmethod
    def of(cls, mesh: o3d.t.geometry.TriangleMesh, frame: LocalFrame) -> Triangles:
        """Of Open3D's mesh, whose positions are in a frame."""
        colors = np.clip(mesh.vertex.colors.numpy(), 0, 1)
        return cls(
            frame.to_world(mesh.vertex.positions.numpy()),
            mesh.triangle.indices.numpy().astype(np.int32),
            np.rint(colors * 255).astype(np.uint8),
        )


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write a mesh.

    Raises:
        DegenerateError: no triangle came out.
        ProjectError: the file cannot be written.
    """
    memory = source.memory
    method = options.method or "tsdf"
    voxel = mesh_voxel(memory) if options.voxel is None else options.voxel
    mesh = METHODS[method](memory, voxel, observed=bool(options.observed))
    made = len(mesh.triangle.indices)
    if options.max_triangles is not None:
        mesh = simplified(mesh, options.max_triangles)
    triangles = Triangles.of(mesh, memory.frame)
    SAVERS[path.suffix.lower()](triangles, path)
    count = len(triangles.faces)
    fewer = f", simplified from {made}" if count < made else ""
    return (
        f"{count} triangles{fewer}, {len(triangles.vertices)} vertices ({method}, voxels of "
        f"{voxel:.4g}) in {path}"
    )


def _save_ply(triangles: Triangles, path: Path) -> None:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(triangles.vertices), o3d.utility.Vector3iVector(triangles.faces)
    )
    mesh.vertex_colors = o3d.utility.Vector3dVector(triangles.colors / 255.0)
    with replaced_when_written(path, suffix=".ply") as temporary:
        if not o3d.io.write_triangle_mesh(str(temporary), mesh):
            raise OSError("Open3D wrote no file")


def _save_glb(triangles: Triangles, path: Path) -> None:
    write_scene(lambda vertices: _trimesh(triangles, vertices), triangles.vertices, path, node=NODE)


def _save_obj(triangles: Triangles, path: Path) -> None:
    from trimesh.exchange.obj import export_obj

    header = "gvtools mesh, input world frame, scene units"
    write_text(path, export_obj(_trimesh(triangles, triangles.vertices), header=header))


def _trimesh(triangles: Triangles, vertices: NDArray[np.floating]) -> object:
    import trimesh

    return trimesh.Trimesh(vertices, triangles.faces, vertex_colors=triangles.colors, process=False)


SAVERS = {".ply": _save_ply, ".glb": _save_glb, ".obj": _save_obj}
