"""Fewer triangles, by Open3D's quadric decimation.

Decimation goes through all edges in order of their cost, one at a time: triangles without area
confuse that order, and a mesh of millions takes minutes. So the mesh is cleaned first, and where
far fewer triangles are wanted, vertices are merged in cells before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gvtools.errors import DegenerateError

if TYPE_CHECKING:
    import open3d as o3d

# Decimation starts from at most so many times the triangles that are wanted.
RATIO = 8
# Cells grow by so much until they leave few enough.
GROWTH = 1.25


def simplified(
    mesh: o3d.t.geometry.TriangleMesh, max_triangles: int
) -> o3d.t.geometry.TriangleMesh:
    """The mesh with at most so many triangles; as it is where it has no more.

    Args:
        mesh: with vertex colours.
        max_triangles: at least 1.
    """
    import open3d as o3d

    if len(mesh.triangle.indices) <= max_triangles:
        return mesh
    legacy = _cleaned(mesh.to_legacy())
    legacy = _merged(legacy, RATIO * max_triangles)
    legacy = _cleaned(legacy.simplify_quadric_decimation(max_triangles))
    # Where borders keep decimation from its number, cells give it.
    legacy = _merged(legacy, max_triangles)
    if not len(legacy.triangles):
        raise DegenerateError(
            f"--max-triangles {max_triangles}: no triangle is left of "
            f"{len(mesh.triangle.indices)}; expected more"
        )
    return o3d.t.geometry.TriangleMesh.from_legacy(legacy)


def _merged(mesh: o3d.geometry.TriangleMesh, most: int) -> o3d.geometry.TriangleMesh:
    """Vertices merged in cells that grow until at most ``most`` triangles are left."""
    if len(mesh.triangles) <= most:
        return mesh
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    edge = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    found = mesh
    while len(found.triangles) > most:
        found = _cleaned(mesh.simplify_vertex_clustering(edge))
        edge *= GROWTH
    return found


def _cleaned(mesh: o3d.geometry.TriangleMesh) -> o3d.geometry.TriangleMesh:
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
