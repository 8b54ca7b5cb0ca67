from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from box_project import VOXEL
from export_runs import Y_UP, export_run, glb_colors

from gvtools.cameras import Cameras, rigid_poses
from gvtools.errors import DegenerateError, OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.export import mesh as meshes
from pipelines.export.mesh import simplify, tsdf_mesh, without_islands

trimesh = pytest.importorskip("trimesh")

ORIGIN = (431_000.0, 5_650_000.0, 120.0)


def cast(vertices, faces, view):
    """What rays of a view's pixels meet of a mesh, by name."""
    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles(
        o3d.core.Tensor(np.asarray(vertices, np.float32)),
        o3d.core.Tensor(np.asarray(faces, np.uint32)),
    )
    camera = view.camera
    K, pose = (
        o3d.core.Tensor(np.ascontiguousarray(x[0])) for x in (camera.K, camera.cam_from_world)
    )
    size = int(camera.width[0]), int(camera.height[0])
    hits = rays.cast_rays(rays.create_rays_pinhole(K, pose, *size))
    return {name: values.numpy() for name, values in hits.items()}


def seen(vertices, faces, view):
    """(H, W) z-depth of a mesh in a view; infinite where no ray meets it."""
    return cast(vertices, faces, view)["t_hit"]


@pytest.mark.parametrize("method", ["tsdf", "poisson"])
def test_trimesh_reads_the_walls(scene, bare_run, tmp_path, method):
    export_run(bare_run.folder, "mesh", tmp_path / "out.ply", "--method", method)
    mesh = trimesh.load(tmp_path / "out.ply", process=False)
    view = scene.views[1]  # not in the memory
    frame = view.load()
    depth = seen(mesh.vertices, mesh.faces, view)
    known = bare_run.memory.project(view.camera).valid[0] & np.isfinite(depth)
    assert known.mean() > 0.7
    assert np.median(np.abs(depth - frame.depth)[known]) < 0.3 * bare_run.memory.voxel
    # Triangles face the cameras, from the inside.
    away = mesh.triangles_center - scene.views[0].camera.centers[0]
    assert ((mesh.face_normals * away).sum(axis=1) < 0).mean() > 0.95
    # Vertices have the walls' colours: each as the pixel that it projects to.
    xy, z = (values[0] for values in view.camera.project(mesh.vertices))
    column, row = np.floor(xy).astype(int).T
    inside = (z > 0) & (column >= 0) & (row >= 0)
    inside &= (column < depth.shape[1]) & (row < depth.shape[0])
    colors = np.asarray(mesh.visual.vertex_colors)[inside, :3].astype(float)
    shown = frame.rgb[row[inside], column[inside]].astype(float)
    assert np.median(np.abs(colors - shown)) < 15
    assert np.corrcoef(colors.ravel(), shown.ravel())[0, 1] > 0.8


def test_no_vertex_of_a_grey_wall_is_black():
    memory, rgb = SpatialMemory(0.01), np.full((240, 320, 3), 133, np.uint8)
    for right in (0, 0.05):
        pose = rigid_poses(np.eye(3), np.array([right, 0, 0]))
        camera = Cameras.pinhole(320, 240, focal=300, cam_from_world=pose, name=f"{right}")
        memory.observe(rgb, np.ones((240, 320), np.float32), camera, round=0)
    colors = tsdf_mesh(memory, 0.02).vertex.colors.numpy() * 255
    assert np.abs(colors - 133).max() < 0.01


def test_all_suffixes_hold_one_mesh(bare_run, tmp_path):
    read = []
    for suffix in (".ply", ".obj", ".glb"):
        out = tmp_path / f"out{suffix}"
        export_run(bare_run.folder, "mesh", out, *Y_UP)
        read.append(trimesh.load(out, process=False, force="mesh"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.glb", "out.obj", "out.ply"]
    colors = [np.asarray(mesh.visual.vertex_colors, int)[:, :3] for mesh in read[:2]]
    colors.append(glb_colors(tmp_path / "out.glb")[0])
    for mesh, shown in zip(read[1:], colors[1:], strict=True):
        np.testing.assert_allclose(mesh.vertices, read[0].vertices, atol=1e-6)
        np.testing.assert_array_equal(mesh.faces, read[0].faces)
        assert np.abs(shown - colors[0]).max() <= 1
    # Open3D reads the PLY as well, and an export may be replaced by another.
    assert len(o3d.io.read_triangle_mesh(str(tmp_path / "out.ply")).triangles) == len(read[0].faces)
    export_run(bare_run.folder, "mesh", tmp_path / "out.obj", "--voxel", 0.1)
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
            export_run(tmp_path / f"{name}.npz", "mesh", out, *Y_UP)
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
    monkeypatch.setattr(meshes, "MOST_BLOCKS", 20)
    with pytest.raises(OptionError, match=r"--voxel 0.02: the scene has \d+ blocks"):
        export_run(bare_run.folder, "mesh", tmp_path / "out.ply", "--voxel", 0.02)
    assert not (tmp_path / "out.ply").exists()
    export_run(bare_run.folder, "mesh", tmp_path / "out.ply")
    assert len(trimesh.load(tmp_path / "out.ply").faces)


def test_voxels_larger_than_the_scene_leave_no_triangle(bare_run, tmp_path):
    with pytest.raises(DegenerateError, match="no triangle"):
        export_run(bare_run.folder, "mesh", tmp_path / "out.ply", "--voxel", 1e6)
    assert not (tmp_path / "out.ply").exists()


FEW = ("--max-triangles", 400)


def shown(mesh, view):
    """(H, W, 3) colours 0 to 255 of trimesh's mesh in a view; NaN where no ray meets it."""
    hit = cast(mesh.vertices, mesh.faces, view)
    face, at, met = hit["primitive_ids"], hit["primitive_uvs"], np.isfinite(hit["t_hit"])
    corners = mesh.faces[face[met]]
    weights = np.stack([1 - at[met].sum(axis=1), *at[met].T], axis=1)
    out = np.full((*met.shape, 3), np.nan)
    if mesh.visual.kind == "texture":
        uv = (mesh.visual.uv[corners] * weights[..., None]).sum(axis=1)
        out[met] = mesh.visual.material.to_color(uv)[:, :3]
    else:
        out[met] = (mesh.visual.vertex_colors[corners, :3] * weights[..., None]).sum(axis=1)
    return out


def error(mesh, view):
    """Root mean square difference to a view's photograph."""
    return float(np.sqrt(np.nanmean(np.square(shown(mesh, view) - view.load().rgb))))


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_few_triangles_show_the_photographs(scene, reconstructed_run, tmp_path, suffix):
    plain, out = tmp_path / "plain.ply", tmp_path / f"a box{suffix}"
    export_run(reconstructed_run.path, "mesh", plain, *FEW)
    export_run(reconstructed_run.path, "mesh", out, "--texture", 512, *FEW, *Y_UP)
    mesh = trimesh.load(out, process=False, force="mesh")
    assert len(mesh.faces) == len(trimesh.load(plain, process=False).faces)
    files = {"a box.glb"} if suffix == ".glb" else {"a box.obj", "a_box.mtl", "a_box.png"}
    assert {path.name for path in tmp_path.iterdir()} == files | {"plain.ply"}
    for row in (1, 4):  # not in the memory as observed
        view = scene.views[row]
        assert error(mesh, view) < 0.7 * error(trimesh.load(plain, process=False), view)


@pytest.mark.parametrize(
    ("name", "words", "match"),
    [
        ("out.ply", ("--texture", 256), ".glb and .obj take a texture"),
        ("out.glb", ("--texture", 32), "expected at least 64 and at most 4096"),
        ("out.glb", ("--texture", 64, "--max-triangles", 500), "give --max-triangles 51"),
    ],
)
def test_textures_that_cannot_be_are_refused(reconstructed_run, tmp_path, name, words, match):
    out = tmp_path / name
    with pytest.raises(OptionError, match=match):
        export_run(reconstructed_run.path, "mesh", out, *words)
    assert not out.exists()


def test_a_memory_alone_has_no_photographs(bare_run, tmp_path):
    with pytest.raises(OptionError, match="is no run"):
        export_run(bare_run.folder, "mesh", tmp_path / "out.glb", "--texture", 256)


def test_files_that_no_export_wrote_are_kept(reconstructed_run, tmp_path):
    (tmp_path / "out.png").write_bytes(b"mine")
    with pytest.raises(OptionError, match=r"out.png: is there already"):
        export_run(reconstructed_run.path, "mesh", tmp_path / "out.obj", "--texture", 256, *FEW)
    assert (tmp_path / "out.png").read_bytes() == b"mine"


def test_small_pieces_are_left_out():
    """Beside a sphere of area 12 one of a hundredth of its radius, with the attributes of both."""
    spheres = [o3d.geometry.TriangleMesh.create_sphere(radius) for radius in (1.0, 0.01)]
    spheres[1].translate((5, 0, 0))
    both = (spheres[0] + spheres[1]).paint_uniform_color((0.25, 0.5, 1))
    mesh = o3d.t.geometry.TriangleMesh.from_legacy(both)
    for least, pieces, left_out in ((0.001, 1, 1), (1e-5, 2, 0), (0, 2, 0)):
        kept, count = without_islands(mesh, least)
        assert count == left_out
        assert len(kept.triangle.indices) == pieces * len(spheres[0].triangles)
        assert (kept.vertex.positions.numpy()[:, 0].max() > 2) == (pieces == 2)
        assert np.ptp(kept.vertex.colors.numpy(), axis=0).max() == 0
