"""Textures of meshes, as trimesh reads them and rays see them."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from export_runs import export_run

from gvtools.errors import OptionError
from pipelines.export.texture import atlas

trimesh = pytest.importorskip("trimesh")

FEW = ("--max-triangles", 400)


def shown(mesh, view):
    """(H, W, 3) colours 0 to 255 of trimesh's mesh in a view; NaN where no ray meets it."""
    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles(
        o3d.core.Tensor(np.asarray(mesh.vertices, np.float32)),
        o3d.core.Tensor(np.asarray(mesh.faces, np.uint32)),
    )
    camera = view.camera
    K, pose = (
        o3d.core.Tensor(np.ascontiguousarray(x[0])) for x in (camera.K, camera.cam_from_world)
    )
    size = int(camera.width[0]), int(camera.height[0])
    hit = rays.cast_rays(rays.create_rays_pinhole(K, pose, *size))
    face, at = hit["primitive_ids"].numpy(), hit["primitive_uvs"].numpy()
    met = np.isfinite(hit["t_hit"].numpy())
    corners = mesh.faces[face[met]]
    weights = np.stack([1 - at[met].sum(axis=1), *at[met].T], axis=1)
    out = np.full((size[1], size[0], 3), np.nan)
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
    export_run(reconstructed_run.path, "--format", "mesh", "--out", plain, *FEW)
    export_run(reconstructed_run.path, "--format", "mesh", "--out", out, "--texture", 512, *FEW)
    mesh = trimesh.load(out, process=False, force="mesh")
    assert len(mesh.faces) == len(trimesh.load(plain, process=False).faces)
    files = {"a box.glb"} if suffix == ".glb" else {"a box.obj", "a_box.mtl", "a_box.png"}
    assert {path.name for path in tmp_path.iterdir()} == files | {"plain.ply"}
    for row in (1, 4):  # not in the memory as observed
        view = scene.views[row]
        assert error(mesh, view) < 0.7 * error(trimesh.load(plain, process=False), view)


@pytest.mark.slow
def test_triangles_lie_apart_and_larger_ones_have_more_texels():
    rng = np.random.default_rng(0)
    scale = rng.choice([0.01, 0.05, 0.2], size=(300, 1, 1))
    triangles = rng.normal(size=(300, 1, 3)) + scale * rng.normal(size=(300, 3, 3))
    corners = atlas(triangles, 256)
    assert corners.min() >= 0.5 and corners.max() <= 255.5
    y, x = np.mgrid[:1024, :1024] / 4 + 0.125
    count = np.zeros(x.shape, int)
    for triangle in corners:
        sides = []
        for start, end in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
            edge = end - start
            # Grown by less than half a texel, into which reading between texels reaches.
            apart = (edge[0] * (y - start[1]) - edge[1] * (x - start[0])) / np.hypot(*edge)
            sides.append(apart > -0.45)
        count += np.logical_and.reduce(sides)
    assert count.max() == 1
    texels = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
    large = scale.ravel() == 0.2
    assert np.median(texels[large]) > 2 * np.median(texels[~large])


@pytest.mark.parametrize(
    ("name", "words", "match"),
    [
        ("out.ply", ("--texture", 256), ".glb and .obj take a texture"),
        ("out.glb", ("--texture", 32), "expected 64 to 4096"),
        ("out.glb", ("--texture", 64, "--max-triangles", 500), "give --max-triangles 51"),
    ],
)
def test_textures_that_cannot_be_are_refused(reconstructed_run, tmp_path, name, words, match):
    out = tmp_path / name
    with pytest.raises(OptionError, match=match):
        export_run(reconstructed_run.path, "--format", "mesh", "--out", out, *words)
    assert not out.exists()


def test_a_memory_alone_has_no_photographs(bare_run, tmp_path):
    words = ("--format", "mesh", "--out", tmp_path / "out.glb", "--texture", 256)
    with pytest.raises(OptionError, match="is no run"):
        export_run(bare_run.folder, *words)


def test_files_that_no_export_wrote_are_kept(reconstructed_run, tmp_path):
    (tmp_path / "out.png").write_bytes(b"mine")
    words = ("--format", "mesh", "--out", tmp_path / "out.obj", "--texture", 256, *FEW)
    with pytest.raises(OptionError, match=r"out.png: is there already"):
        export_run(reconstructed_run.path, *words)
    assert (tmp_path / "out.png").read_bytes() == b"mine"
