"""Meshes of a memory: a TSDF of depth maps rendered from it, or Poisson reconstruction.

Both are Open3D's. Coordinates are relative to the memory's own frame, where float32 is precise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import DegenerateError, OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.thinning import thinned

if TYPE_CHECKING:
    import open3d as o3d

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
    import open3d as o3d

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
    mesh = grid.extract_triangle_mesh(LEAST_WEIGHT)
    return _ordered(_checked(mesh, f"a TSDF of voxels of {voxel:.4g}"))


def _blocks(memory: SpatialMemory, edge: float) -> int:
    """Number of grid cubes of edge ``edge`` [scene units] that hold a point of a memory."""
    cells = np.floor(memory.columns.positions.astype(np.float64) / edge).astype(np.int64)
    return len(np.unique(cells, axis=0))


def _ordered(mesh: o3d.t.geometry.TriangleMesh) -> o3d.t.geometry.TriangleMesh:
    """The mesh with vertices and triangles sorted: Open3D's threads give them in any order."""
    import open3d as o3d

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
            yield from _around(camera.centers[0], camera.names[0])
            continue
        arrays = (camera.K, camera.cam_from_world, camera.width, camera.height)
        key = tuple(array.tobytes() for array in arrays)
        if key not in seen and not (observed and view.generated):
            seen.add(key)
            yield camera


def _around(center: NDArray[np.float64], name: str) -> Iterator[Cameras]:
    """Six cameras that together see all around a place, (3,) in the world."""
    half = FACE / 2
    K = np.array([[[half, 0, half], [0, half, half], [0, 0, 1.0]]])
    axes, size = np.eye(3), np.array([FACE])
    for k in range(3):
        for forward in (axes[k], -axes[k]):
            right = axes[k - 1]
            pose = np.eye(4)
            pose[:3, :3] = right, np.cross(forward, right), forward
            pose[:3, 3] = -pose[:3, :3] @ center
            yield Cameras(K, pose[None], size, size, (f"{name} {forward.tolist()}",))


def poisson_mesh(
    memory: SpatialMemory, voxel: float, *, observed: bool = False
) -> o3d.t.geometry.TriangleMesh:
    """Screened Poisson reconstruction of the memory's points, cut off where there are none.

    Normals are those of the nearest points, turned to the view that saw the point. ``voxel`` is
    the edge of the finest cells, scene units; ``observed`` leaves out what a completer made.
    """
    import open3d as o3d

    chosen = ~memory.generated if observed else np.ones(len(memory), np.bool_)
    if not chosen.any():
        raise DegenerateError("the memory holds nothing that was observed; leave out --observed")
    rows = thinned(memory, None, among=chosen).rows
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
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(positions))
    search.knn_index()
    _, squared = search.knn_search(o3d.core.Tensor(np.asarray(mesh.vertices)), 1)
    reach = REACH * max(voxel, extent * 1.1 / 2**levels)
    mesh.remove_vertices_by_mask(squared.numpy()[:, 0] > reach**2)
    made = o3d.t.geometry.TriangleMesh.from_legacy(mesh)
    return _checked(made, f"Poisson reconstruction with {levels} levels")


def _checked(mesh: o3d.t.geometry.TriangleMesh, method: str) -> o3d.t.geometry.TriangleMesh:
    if "indices" not in mesh.triangle or not len(mesh.triangle.indices):
        raise DegenerateError(f"{method} has no triangle; give another --voxel or --method")
    return mesh
