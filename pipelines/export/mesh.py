"""A mesh with vertex colours or a texture, as PLY, glTF binary or OBJ, in the world frame.

It has fewer triangles by Open3D's quadric decimation, which goes through all edges in order of
their cost, one at a time: triangles without area confuse that order, and a mesh of millions takes
minutes. So the mesh is cleaned first, and where far fewer triangles are wanted, vertices are merged
in cells before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import DegenerateError, OptionError
from gvtools.files import replaced_when_written, write_text
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.runs.layout import RECORD
from gvtools.runs.run import load_run
from pipelines.export.formats import ExportOptions
from pipelines.export.points import write_glb_scene
from pipelines.export.source import ExportSource
from pipelines.export.surfaces import mesh_voxel, poisson_mesh, tsdf_mesh
from pipelines.export.texture import TEXELS, Texture, texture_of

if TYPE_CHECKING:
    import open3d as o3d

METHODS = {"tsdf": tsdf_mesh, "poisson": poisson_mesh}
NODE = "gvtools_mesh"
# Decimation starts from at most so many times the triangles that are wanted.
RATIO = 8
# Cells grow by so much until they leave few enough.
GROWTH = 1.25


@dataclass(frozen=True, eq=False)
class Triangles:
    """A mesh as files hold it."""

    vertices: NDArray[np.float64]  # (V, 3) world frame, scene units
    faces: NDArray[np.int32]  # (F, 3) rows of ``vertices``, against the clock seen from outside
    colors: NDArray[np.uint8]  # (V, 3)
    # Where triangles have their colours in a picture; their vertices are their own, in order.
    texture: Texture | None = None

    @classmethod
    def of(
        cls, mesh: o3d.t.geometry.TriangleMesh, frame: LocalFrame, texture: Texture | None = None
    ) -> Triangles:
        """Of Open3D's mesh, whose positions are in a frame."""
        positions = frame.to_world(mesh.vertex.positions.numpy())
        colors = np.rint(np.clip(mesh.vertex.colors.numpy(), 0, 1) * 255).astype(np.uint8)
        faces = mesh.triangle.indices.numpy().astype(np.int32)
        if texture is None:
            return cls(positions, faces, colors)
        own = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
        return cls(positions[faces.ravel()], own, colors[faces.ravel()], texture)


def write_mesh(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write a mesh."""
    memory, size = source.memory, options.texture
    if size is not None:
        _check_texture(source, path)
    method = options.method
    voxel = mesh_voxel(memory) if options.voxel is None else options.voxel
    mesh = METHODS[method](memory, voxel, observed=options.observed)
    made = len(mesh.triangle.indices)
    most = options.max_triangles
    if size is not None and most is None:
        most = size**2 // TEXELS
    if most is not None:
        mesh = simplify(mesh, most)
    texture = None if size is None else texture_of(mesh, _photographs(source), size)
    triangles = Triangles.of(mesh, memory.frame, texture)
    SAVERS[path.suffix.lower()](triangles, path)
    count = len(triangles.faces)
    fewer = f", simplified from {made}" if count < made else ""
    colors = "" if size is None else f", a texture of {size} x {size}"
    return (
        f"{count} triangles{fewer}, {len(mesh.vertex.positions)} vertices{colors} ({method}, "
        f"voxels of {voxel:.4g}) in {path}"
    )


def _check_texture(source: ExportSource, path: Path) -> None:
    if path.suffix.lower() == ".ply":
        raise OptionError(
            f"--texture: {path} is to be a PLY; .glb and .obj take a texture, a .ply has vertex "
            "colours alone; give --out one of these, or leave --texture out"
        )
    if not (source.path / RECORD).is_file():
        raise OptionError(
            f"--texture: {source.path} is no run; expected a run's folder, whose project has the "
            "photographs"
        )
    for suffix in (".mtl", ".png"):
        other = path.with_name(_material(path) + suffix)
        if path.suffix.lower() == ".obj" and other.exists() and not path.exists():
            raise OptionError(
                f"{other}: is there already and would be replaced; give another --out"
            )


def _photographs(source: ExportSource) -> Iterator[tuple[Cameras, NDArray[np.uint8]]]:
    """Cameras of the observed views in the memory's frame, and their photographs."""
    scene = load_run(source.path).scenes[0]
    for view in source.memory.views.photographed:
        picture = scene[view.camera.names[0]].load().rgb
        camera = source.memory.frame.seen_from(view.camera)
        yield camera.resized(picture.shape[1], picture.shape[0]), picture


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
    write_glb_scene(
        lambda vertices: _trimesh(triangles, vertices), triangles.vertices, path, node=NODE
    )


def _save_obj(triangles: Triangles, path: Path) -> None:
    from trimesh.exchange.obj import export_obj

    header = "gvtools mesh, input world frame, scene units"
    name = _material(path)
    mesh = _trimesh(triangles, triangles.vertices, material=name)
    if triangles.texture is None:
        write_text(path, export_obj(mesh, header=header))
        return
    text, beside = export_obj(mesh, header=header, return_texture=True, mtl_name=f"{name}.mtl")
    for name, content in beside.items():
        with replaced_when_written(path.with_name(name)) as temporary:
            temporary.write_bytes(content)
    write_text(path, text)


def _material(path: Path) -> str:
    """Name of an OBJ's material and of the files beside it; OBJ ends names at a space."""
    return "_".join(path.stem.split())


def _trimesh(
    triangles: Triangles, vertices: NDArray[np.floating], *, material: str = NODE
) -> object:
    import trimesh

    if triangles.texture is None:
        return trimesh.Trimesh(
            vertices, triangles.faces, vertex_colors=triangles.colors, process=False
        )
    from PIL import Image

    visuals = trimesh.visual.TextureVisuals(
        uv=triangles.texture.uv.reshape(-1, 2),
        material=trimesh.visual.material.PBRMaterial(
            name=material,
            baseColorTexture=Image.fromarray(triangles.texture.image),
            metallicFactor=0.0,
            roughnessFactor=1.0,
        ),
    )
    return trimesh.Trimesh(vertices, triangles.faces, visual=visuals, process=False)


def simplify(mesh: o3d.t.geometry.TriangleMesh, max_triangles: int) -> o3d.t.geometry.TriangleMesh:
    """The mesh with at most so many triangles; as it is where it has no more."""
    import open3d as o3d

    if len(mesh.triangle.indices) <= max_triangles:
        return mesh
    legacy = _clean(mesh.to_legacy())
    legacy = _merge_vertices(legacy, RATIO * max_triangles)
    legacy = _clean(legacy.simplify_quadric_decimation(max_triangles))
    # Where borders keep decimation from its number, cells give it.
    legacy = _merge_vertices(legacy, max_triangles)
    if not len(legacy.triangles):
        raise DegenerateError(
            f"--max-triangles {max_triangles}: no triangle is left of "
            f"{len(mesh.triangle.indices)}; expected more"
        )
    return o3d.t.geometry.TriangleMesh.from_legacy(legacy)


def _merge_vertices(mesh: o3d.geometry.TriangleMesh, most: int) -> o3d.geometry.TriangleMesh:
    """Vertices merged in cells that grow until at most ``most`` triangles are left."""
    if len(mesh.triangles) <= most:
        return mesh
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    edge = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    fewer = mesh
    while len(fewer.triangles) > most:
        fewer = _clean(mesh.simplify_vertex_clustering(edge))
        edge *= GROWTH
    return fewer


def _clean(mesh: o3d.geometry.TriangleMesh) -> o3d.geometry.TriangleMesh:
    mesh.remove_duplicated_vertices()
    mesh.remove_degenerate_triangles()
    mesh.remove_duplicated_triangles()
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    mesh.remove_triangles_by_mask(~(area > 0))
    mesh.remove_unreferenced_vertices()
    return mesh


SAVERS = {".ply": _save_ply, ".glb": _save_glb, ".obj": _save_obj}
