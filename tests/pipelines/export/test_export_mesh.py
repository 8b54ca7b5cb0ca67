"""Meshes, as other libraries read them and rays meet them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from box_project import VOXEL
from export_runs import export_run

from gvtools.errors import DegenerateError, OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.export import surfaces
from pipelines.export.mesh import simplify
from pipelines.export.surfaces import tsdf_mesh

trimesh = pytest.importorskip("trimesh")

ORIGIN = (431_000.0, 5_650_000.0, 120.0)


def seen(vertices, faces, view):
    """(H, W) z-depth of a mesh in a view; infinite where no ray meets it."""
    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles(
        o3d.core.Tensor(np.asarray(vertices, np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    camera = view.camera
    K, pose = (
        o3d.core.Tensor(np.ascontiguousarray(x[0])) for x in (camera.K, camera.cam_from_world)
    )
    size = int(camera.width[0]), int(camera.height[0])
    return rays.cast_rays(rays.create_rays_pinhole(K, pose, *size))["t_hit"].numpy()


@pytest.mark.parametrize("method", ["tsdf", "poisson"])
def test_trimesh_reads_the_walls(scene, bare_run, tmp_path, method):
    export_run(
        bare_run.folder, "--format", "mesh", "--out", tmp_path / "out.ply", "--method", method
    )
    mesh = trimesh.load(tmp_path / "out.ply", process=False)
    view = scene.views[1]  # not in the memory
    frame = view.load()
    depth = seen(mesh.vertices, mesh.faces, view)
    known = bare_run.memory.project(view.camera).valid[0] & np.isfinite(depth)
    assert known.mean() > 0.7
    assert np.median(np.abs(depth - frame.depth)[known]) < 0.3 * bare_run.memory.voxel
    # Vertices have the walls' colours: each as the pixel that it projects to.
    xy, z = (values[0] for values in view.camera.project(mesh.vertices))
    column, row = np.floor(xy).astype(int).T
    inside = (z > 0) & (column >= 0) & (row >= 0)
    inside &= (column < depth.shape[1]) & (row < depth.shape[0])
    colors = np.asarray(mesh.visual.vertex_colors)[inside, :3].astype(float)
    shown = frame.rgb[row[inside], column[inside]].astype(float)
    assert np.median(np.abs(colors - shown)) < 15
    assert np.corrcoef(colors.ravel(), shown.ravel())[0, 1] > 0.8


def test_triangles_face_the_cameras(scene, bare_run, tmp_path):
    export_run(bare_run.folder, "--format", "mesh", "--out", tmp_path / "out.ply")
    mesh = trimesh.load(tmp_path / "out.ply", process=False)
    away = mesh.triangles_center - scene.views[0].camera.centers[0]
    assert ((mesh.face_normals * away).sum(axis=1) < 0).mean() > 0.95


def test_all_suffixes_hold_one_mesh(bare_run, tmp_path):
    read = []
    for suffix in (".ply", ".obj", ".glb"):
        out = tmp_path / f"out{suffix}"
        export_run(bare_run.folder, "--format", "mesh", "--out", out)
        read.append(trimesh.load(out, process=False, force="mesh"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.glb", "out.obj", "out.ply"]
    for mesh in read[1:]:
        np.testing.assert_allclose(mesh.vertices, read[0].vertices, atol=1e-6)
        np.testing.assert_array_equal(mesh.faces, read[0].faces)
        apart = np.abs(
            np.asarray(mesh.visual.vertex_colors, int)
            - np.asarray(read[0].visual.vertex_colors, int)
        )
        assert apart.max() <= 1
    # Open3D reads the PLY as well, and an export may be replaced by another.
    assert len(o3d.io.read_triangle_mesh(str(tmp_path / "out.ply")).triangles) == len(read[0].faces)
    export_run(bare_run.folder, "--format", "mesh", "--out", tmp_path / "out.obj", "--voxel", 0.1)
    assert len(trimesh.load(tmp_path / "out.obj", force="mesh").faces) < len(read[0].faces) / 2


def test_a_mesh_far_from_the_origin_keeps_its_digits(scene, tmp_path):
    view = scene.views[0]
    frame, camera = view.load(), view.camera
    for name, origin in (("near", (0.0, 0.0, 0.0)), ("far", ORIGIN)):
        pose = camera.cam_from_world.copy()
        pose[:, :3, 3] -= pose[:, :3, :3] @ np.array(origin)
        memory = SpatialMemory(VOXEL, origin=origin)
        moved = replace(camera, cam_from_world=pose)
        memory.observe(frame.rgb, frame.depth, moved, round=0)
        memory.save(tmp_path / f"{name}.npz")
    read = {}
    for name in ("near", "far"):
        for suffix in (".ply", ".glb"):
            out = tmp_path / f"{name}{suffix}"
            export_run(tmp_path / f"{name}.npz", "--format", "mesh", "--out", out)
            read[name, suffix] = trimesh.load(out, process=False, force="mesh").vertices
    for suffix in (".ply", ".glb"):
        one, two = read["near", suffix], read["far", suffix] - ORIGIN
        assert len(one) == len(two)
        np.testing.assert_allclose(two, one, atol=2e-3)


def test_observed_leaves_out_generated_views_and_points(scene, bare_run):
    edge = 2 * bare_run.memory.voxel
    whole, observed = (tsdf_mesh(bare_run.memory, edge, observed=each) for each in (False, True))
    view = scene.views[4]  # the generated one
    hit = [
        np.isfinite(seen(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), view)).mean()
        for mesh in (whole, observed)
    ]
    assert hit[0] > hit[1] + 0.1


@pytest.mark.parametrize("share", [0.5, 0.02])
def test_simplified_meshes_keep_number_place_and_colours(scene, bare_run, share):
    mesh = tsdf_mesh(bare_run.memory, bare_run.memory.voxel)
    most = int(share * len(mesh.triangle.indices))
    fewer = simplify(mesh, most)
    assert 0.3 * most < len(fewer.triangle.indices) <= most
    view = scene.views[1]
    depths = [
        seen(each.vertex.positions.numpy(), each.triangle.indices.numpy(), view)
        for each in (mesh, fewer)
    ]
    both = np.isfinite(depths[0]) & np.isfinite(depths[1])
    assert both.mean() > 0.7
    assert np.median(np.abs(depths[0][both] - depths[1][both])) < bare_run.memory.voxel
    assert fewer.vertex.colors.numpy().std() > 0.05


def test_triangles_without_area_do_not_stop_the_simplification(bare_run):
    mesh = tsdf_mesh(bare_run.memory, bare_run.memory.voxel)
    faces = mesh.triangle.indices.numpy()
    flat = faces[:500].copy()
    flat[:, 2] = flat[:, 1]
    mesh.triangle.indices = o3d.core.Tensor(np.concatenate([faces, flat, faces[:500]]))
    assert 0 < len(simplify(mesh, 400).triangle.indices) <= 400


def test_voxels_that_would_fill_the_memory_are_refused_or_widened(bare_run, tmp_path, monkeypatch):
    monkeypatch.setattr(surfaces, "MOST_BLOCKS", 20)
    with pytest.raises(OptionError, match=r"--voxel 0.02: the scene has \d+ blocks"):
        export_run(
            bare_run.folder, "--format", "mesh", "--out", tmp_path / "out.ply", "--voxel", 0.02
        )
    assert not (tmp_path / "out.ply").exists()
    export_run(bare_run.folder, "--format", "mesh", "--out", tmp_path / "out.ply")
    assert len(trimesh.load(tmp_path / "out.ply").faces)


def test_voxels_larger_than_the_scene_leave_no_triangle(bare_run, tmp_path):
    with pytest.raises(DegenerateError, match="no triangle"):
        export_run(
            bare_run.folder, "--format", "mesh", "--out", tmp_path / "out.ply", "--voxel", 1e6
        )
    assert not (tmp_path / "out.ply").exists()
