"""Meshes of a memory with vertex colours or a texture, as PLY, glTF binary or OBJ.

They come from a TSDF of depth maps rendered from the memory, or from Poisson reconstruction, both
of Open3D, in the memory's own frame, where float32 is precise.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gvtools.cameras import Cameras, rigid_poses
from gvtools.errors import DegenerateError, OptionError
from gvtools.files import replaced_when_written, write_text
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.thinning import thin
from gvtools.o3d import o3d
from gvtools.optional import require
from gvtools.ply import up_comment, write_ply
from gvtools.runs.layout import RECORD
from gvtools.runs.run import load_run
from gvtools.scenes.undistort import DIRECTIONS, face_rotation
from pipelines.export.formats import ExportOptions
from pipelines.export.points import UNLIT, axes_of, linear, save_glb, unlit
from pipelines.export.source import ExportSource
from pipelines.export.texture import TEXELS, Texture, texture_of

Up = NDArray[np.float64] | None
# The edge of a mesh's voxels is at least PER_VOXEL edges of the memory's finest voxels, and
# PER_FOOTPRINT times the quantile MOST of its observations' spacing.
PER_VOXEL, PER_FOOTPRINT, MOST = 2.0, 1.0, 0.9
# Open3D's VoxelBlockGrid: voxels along a side of a block; it starts with room for ROOM times the
# blocks that hold a point, and for LEAST_BLOCKS more, and grows when needed.
BLOCK_SIDE, ROOM, LEAST_BLOCKS = 16, 3, 64
# More blocks that hold a point, of 82 kB each, do not fit the RAM of a small machine.
MOST_BLOCKS = 30_000
# Voxels grow by this factor until the scene has few enough blocks.
WIDER = 1.25
# Side of the six pictures in which a scanner's surroundings are rendered [px].
FACE = 1024
# Open3D's message for a picture without depth.
NOTHING = "No block is touched"
# Truncation distance of the TSDF, in voxels.
TRUNCATION = 4.0
# Voxels of a larger weight are meshed: the weight is the number of views, so one is enough.
LEAST_WEIGHT = 0.5
# A depth limit beyond every scene, scene units.
FAR = 1e9
# Poisson: neighbours that a normal is estimated from, the most octree levels, and the distance from
# the points at which the surface is cut off, in voxels.
NEIGHBOURS, MOST_LEVELS, REACH = 24, 11, 3.0


def mesh_voxel(memory: SpatialMemory) -> float:
    """Default edge of the voxels for a memory's mesh, scene units."""
    footprint = float(np.quantile(memory.columns.spacing, MOST))
    voxel = max(PER_VOXEL * memory.voxel, PER_FOOTPRINT * footprint)
    while _blocks(memory, BLOCK_SIDE * voxel) > MOST_BLOCKS:
        voxel *= WIDER
    return voxel


def tsdf_mesh(
    memory: SpatialMemory, voxel: float, *, observed: bool = False
) -> o3d.t.geometry.TriangleMesh:
    """Integrate the memory's depth, rendered from its own views, into a TSDF, and mesh it.

    ``voxel`` is the edge, scene units; ``observed`` leaves out generated points and views.
    """
    kind = o3d.core.float32
    blocks_held = _blocks(memory, BLOCK_SIDE * voxel)
    if blocks_held > MOST_BLOCKS:
        raise OptionError(
            f"--voxel {voxel:g}: the scene has {blocks_held} blocks of {BLOCK_SIDE} such voxels a "
            f"side; expected at most {MOST_BLOCKS}; larger ones, such as {mesh_voxel(memory):.4g}, "
            "have fewer"
        )
    room = ROOM * blocks_held + LEAST_BLOCKS
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (kind, kind, kind), ((1), (1), (3)), voxel, BLOCK_SIDE, room
    )
    for camera in _cameras(memory, observed=observed):
        shown = memory.project(camera)
        depth = shown.depth[0]
        if observed:
            depth = np.where(shown.generated[0], np.float32(0), depth)
        local = memory.frame.seen_from(camera)
        # Open3D has the first pixel's centre at (0, 0), not (0.5, 0.5).
        K = local.K[0] - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        lens, pose = (
            o3d.core.Tensor(np.ascontiguousarray(x)) for x in (K, local.cam_from_world[0])
        )
        images = [
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(x, np.float32)))
            for x in (depth, shown.rgb[0])
        ]
        try:
            blocks = grid.compute_unique_block_coordinates(
                images[0], lens, pose, 1.0, FAR, TRUNCATION
            )
        except RuntimeError as error:
            if NOTHING in str(error):
                continue
            raise
        grid.integrate(blocks, *images, lens, lens, pose, 1.0, FAR, TRUNCATION)
    mesh = _checked(grid.extract_triangle_mesh(LEAST_WEIGHT), f"a TSDF of voxels of {voxel:.4g}")
    # Beside blocks that no picture reaches, Open3D leaves vertices black.
    colors = mesh.vertex.colors.numpy()
    if (black := ~colors.any(axis=1)).any():
        near, _ = _nearest(memory.columns.positions, mesh.vertex.positions.numpy()[black])
        colors[black] = memory.columns.colors[near] / 255
    return _ordered(mesh)


def _blocks(memory: SpatialMemory, edge: float) -> int:
    """Number of grid cubes of edge ``edge`` [scene units] that hold a point of a memory."""
    cells = np.floor(memory.columns.positions.astype(np.float64) / edge).astype(np.int64)
    return len(np.unique(cells, axis=0))


def _ordered(mesh: o3d.t.geometry.TriangleMesh) -> o3d.t.geometry.TriangleMesh:
    """The mesh with vertices and triangles sorted: Open3D's threads give them in any order."""
    positions, colors = mesh.vertex.positions.numpy(), mesh.vertex.colors.numpy()
    order = np.lexsort(positions.T)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    faces = rank[mesh.triangle.indices.numpy()]
    # Begin each triangle with its least vertex; cyclic order, and so orientation, is unchanged.
    first = faces.argmin(axis=1)[:, None]
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    out = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(positions[order]), o3d.core.Tensor(np.ascontiguousarray(faces))
    )
    out.vertex.colors = o3d.core.Tensor(colors[order])
    return out


def _cameras(memory: SpatialMemory, *, observed: bool) -> Iterator[Cameras]:
    """The cameras of the memory's views, each once; six around each station of a scan."""
    seen = set()
    for view in memory.views:
        camera = view.camera
        if view.scanned:
            for face in DIRECTIONS:
                turn = face_rotation(face)
                pose = rigid_poses(turn, -turn @ camera.centers[0])
                yield Cameras.pinhole(FACE, FACE, focal=FACE / 2, cam_from_world=pose, name=face)
            continue
        arrays = (camera.K, camera.cam_from_world, camera.width, camera.height)
        key = tuple(array.tobytes() for array in arrays)
        if key not in seen and not (observed and view.generated):
            seen.add(key)
            yield camera


def poisson_mesh(
    memory: SpatialMemory, voxel: float, *, observed: bool = False
) -> o3d.t.geometry.TriangleMesh:
    """Screened Poisson reconstruction of the memory's points, cut off where there are none.

    Normals are those of the nearest points, turned to the view that saw the point. ``voxel`` is
    the edge of the finest cells, scene units; ``observed`` leaves out what a completer made.
    """
    chosen = ~memory.generated if observed else np.ones(len(memory), np.bool_)
    if not chosen.any():
        raise DegenerateError("the memory holds nothing that was observed; leave out --observed")
    rows = thin(memory, None, among=chosen).rows
    columns = memory.columns
    positions = columns.positions[rows].astype(np.float64)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(positions))
    cloud.colors = o3d.utility.Vector3dVector(columns.colors[rows] / 255.0)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    away = positions - memory.views.centers[columns.view[rows]]
    normals[(normals * away).sum(axis=1) > 0] *= -1
    cloud.normals = o3d.utility.Vector3dVector(normals)
    extent = float(np.ptp(positions, axis=0).max())
    levels = int(np.clip(np.ceil(np.log2(1.1 * extent / voxel)), 5, MOST_LEVELS))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=levels)
    _, squared = _nearest(positions, np.asarray(mesh.vertices))
    reach = REACH * max(voxel, extent * 1.1 / 2**levels)
    mesh.remove_vertices_by_mask(squared > reach**2)
    made = o3d.t.geometry.TriangleMesh.from_legacy(mesh)
    return _checked(made, f"Poisson reconstruction with {levels} levels")


def _nearest(points: NDArray[Any], places: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """For each place (P, 3) the row of the nearest point (N, 3), and its squared distance."""
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(np.ascontiguousarray(points)))
    search.knn_index()
    found = search.knn_search(o3d.core.Tensor(np.ascontiguousarray(places, points.dtype)), 1)
    rows, squared = (each.numpy()[:, 0] for each in found)
    return rows, squared


def _checked(mesh: o3d.t.geometry.TriangleMesh, method: str) -> o3d.t.geometry.TriangleMesh:
    if "indices" not in mesh.triangle or not len(mesh.triangle.indices):
        raise DegenerateError(f"{method} has no triangle; give another --voxel or --method")
    return mesh


METHODS = {"tsdf": tsdf_mesh, "poisson": poisson_mesh}
NODE, HEADER = "gvtools_mesh", "gvtools mesh, input world frame, scene units"
CHANNELS = ("red", "green", "blue")


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
    memory, size, method = source.memory, options.texture, options.method
    if size is not None:
        _check_texture(source, path)
    voxel = mesh_voxel(memory) if options.voxel is None else options.voxel
    mesh = METHODS[method](memory, voxel, observed=options.observed)
    mesh, islands = without_islands(mesh, options.least_piece)
    made = len(mesh.triangle.indices)
    most = options.max_triangles
    if size is not None and most is None:
        most = size**2 // TEXELS
    if most is not None:
        mesh = simplify(mesh, most)
    texture = None if size is None else texture_of(mesh, _photographs(source), size)
    triangles = Triangles.of(mesh, memory.frame, texture)
    SAVERS[path.suffix.lower()](triangles, path, source.up)
    count = len(triangles.faces)
    fewer = f", simplified from {made}" if count < made else ""
    fewer += f", without {islands} small pieces (--least-piece)" if islands else ""
    colors = "" if size is None else f", a texture of {size} x {size}"
    axes = axes_of(source.up) if path.suffix.lower() == ".glb" else ""
    return (
        f"{count} triangles{fewer}, {len(mesh.vertex.positions)} vertices{colors} ({method}, "
        f"voxels of {voxel:.4g}) in {path}{axes}"
    )


def without_islands(
    mesh: o3d.t.geometry.TriangleMesh, least: float
) -> tuple[o3d.t.geometry.TriangleMesh, int]:
    """The mesh without pieces below a share of the largest one's area, and how many these were."""
    labels, _, areas = mesh.to_legacy().cluster_connected_triangles()
    small = np.asarray(areas) < least * max(areas)
    if not small.any():
        return mesh, 0
    kept = o3d.core.Tensor(~small[np.asarray(labels)])
    return mesh.select_faces_by_mask(kept), int(small.sum())


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


def _save_ply(triangles: Triangles, path: Path, up: Up) -> None:
    kind = [*((axis, "<f8") for axis in "xyz"), *((name, "u1") for name in CHANNELS)]
    rows = np.empty(len(triangles.vertices), kind)
    for axis, name, column, color in zip(
        "xyz", CHANNELS, triangles.vertices.T, triangles.colors.T, strict=True
    ):
        rows[axis], rows[name] = column, color
    write_ply(path, rows, faces=triangles.faces, comments=(HEADER, *up_comment(up)))


def _save_glb(triangles: Triangles, path: Path, up: Up) -> None:
    texture, png = triangles.texture, io.BytesIO()
    if texture is None:
        attributes, material = {"COLOR_0": linear(triangles.colors / 255)}, unlit()
    else:
        # From the upper left corner.
        uv = texture.corners.reshape(-1, 2) / len(texture.image)
        attributes = {"TEXCOORD_0": uv.astype(np.float32)}
        material = unlit(baseColorTexture={"index": 0})
        Image.fromarray(texture.image).save(png, "PNG")
    save_glb(
        path, triangles.vertices, attributes, name=NODE, up=up, primitive={"material": 0},
        indices=triangles.faces.astype(np.uint32), picture=png.getvalue(),
        materials=[material], extensionsUsed=[UNLIT],
    )  # fmt: skip


def _save_obj(triangles: Triangles, path: Path, up: Up) -> None:
    trimesh = require("trimesh", extra="export", purpose=f"--out {path}")
    name, texture = _material(path), triangles.texture
    if texture is None:
        colors: dict[str, Any] = {"vertex_colors": triangles.colors}
    else:
        picture = Image.fromarray(texture.image)
        material = trimesh.visual.material.PBRMaterial(
            name=name, baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=1.0
        )
        uv = texture.uv.reshape(-1, 2)
        colors = {"visual": trimesh.visual.TextureVisuals(uv=uv, material=material)}
    mesh = trimesh.Trimesh(triangles.vertices, triangles.faces, process=False, **colors)
    text, beside = trimesh.exchange.obj.export_obj(
        mesh, header="\n# ".join([HEADER, *up_comment(up)]), return_texture=True,
        mtl_name=f"{name}.mtl",
    )  # fmt: skip
    for name, content in beside.items():
        with replaced_when_written(path.with_name(name)) as temporary:
            temporary.write_bytes(content)
    write_text(path, text)


def _material(path: Path) -> str:
    """Name of an OBJ's material and of the files beside it; OBJ ends names at a space."""
    return "_".join(path.stem.split())


def simplify(mesh: o3d.t.geometry.TriangleMesh, max_triangles: int) -> o3d.t.geometry.TriangleMesh:
    """The mesh with at most so many triangles; as it is where it has no more.

    VTK, which decimates it, leaves no colours: each vertex takes that of the nearest place before.
    """
    count = len(mesh.triangle.indices)
    if count <= max_triangles:
        return mesh
    a, b, c = mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy().T]
    # VTK crashes on triangles without area.
    whole = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0
    mesh = mesh.select_faces_by_mask(o3d.core.Tensor(whole))
    bare = o3d.t.geometry.TriangleMesh(mesh.vertex.positions, mesh.triangle.indices)
    fewer = bare.simplify_quadric_decimation(max(0, 1 - max_triangles / int(whole.sum())))
    if not len(fewer.triangle.indices):
        raise DegenerateError(
            f"--max-triangles {max_triangles}: no triangle is left of {count}; expected more"
        )
    before = o3d.t.geometry.RaycastingScene()
    before.add_triangles(bare)
    near = before.compute_closest_points(fewer.vertex.positions.to(o3d.core.float32))
    corners = mesh.triangle.indices.numpy()[near["primitive_ids"].numpy()]
    shares = near["primitive_uvs"].numpy()
    shares = np.column_stack([1 - shares.sum(axis=1), shares])
    colors = np.einsum("nk,nkc->nc", shares, mesh.vertex.colors.numpy()[corners])
    fewer.vertex.colors = o3d.core.Tensor(colors.astype(np.float32))
    return fewer


SAVERS = {".ply": _save_ply, ".glb": _save_glb, ".obj": _save_obj}
