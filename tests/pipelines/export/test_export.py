from __future__ import annotations

import json
import sys

import numpy as np
import pycolmap
import pytest
from box_project import fused
from export_runs import Y_UP, export_run, glb_colors
from PIL import Image
from plyfile import PlyData

from gvtools.errors import OptionError, ProjectError
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.thinning import thin
from gvtools.scenes.project import open_project
from pipelines.export.formats import FORMATS


@pytest.fixture(scope="module")
def memory(scene):
    return fused(scene, [0, 2, 4], generated=(4,))


@pytest.fixture
def saved(memory, tmp_path):
    """A run's folder with the memory, and a picture of the generated view."""
    folder = tmp_path / "run"
    folder.mkdir()
    memory.save(folder / "memory.npz")
    (folder / "round_002").mkdir()
    Image.new("RGB", (96, 72)).save(folder / "round_002" / "generated_view_4.png")
    return folder


def test_an_earlier_round(memory, saved, tmp_path):
    export_run(saved, "ply", tmp_path / "cloud.ply", "--round", 1)
    vertex = PlyData.read(tmp_path / "cloud.ply")["vertex"]
    rounds = memory.views.round[memory.columns.view[: len(memory)]]
    assert vertex.count == int((rounds <= 1).sum())
    assert not vertex["generated"].any()
    with pytest.raises(OptionError, match="rounds 0, 1, 2"):
        export_run(saved, "ply", tmp_path / "cloud.ply", "--round", 7)


def test_colmap_reads_the_model_back(scene, memory, saved, tmp_path):
    export_run(saved, "colmap", tmp_path / "out", "--max-points", 1500)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert model.num_reg_images() == 3
    for image in model.images.values():
        camera = scene[image.name.removeprefix("generated/")].camera
        np.testing.assert_allclose(
            image.cam_from_world().matrix(), camera.cam_from_world[0, :3], atol=1e-12
        )
        np.testing.assert_allclose(image.camera.calibration_matrix(), camera.K[0])
    in_order = [model.points3D[i] for i in sorted(model.points3D)]
    points = np.array([point.xyz for point in in_order])
    colors = np.array([point.color for point in in_order])
    kept = thin(memory, 1500)
    np.testing.assert_allclose(points, memory.positions[kept.rows])
    np.testing.assert_array_equal(colors, memory.columns.colors[kept.rows])
    # Detections are those of the observations themselves: within a thinned voxel of the point.
    focal = scene.views[0].camera.K[0, 0, 0]
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < focal * np.sqrt(3) * kept.edge / 0.8
    assert model.compute_mean_track_length() > 1
    names = (tmp_path / "out/sparse/0/generated.txt").read_text().splitlines()[1:]
    assert [line.split("\t")[0] for line in names] == ["generated/view_4.png"]
    assert not (tmp_path / "out" / "images").exists()


def test_transforms_open_as_a_project(scene, memory, saved, tmp_path):
    folder = scene.root
    export_run(saved, "transforms", tmp_path / "out", "--images", folder / "images")
    project = open_project(tmp_path / "out" / "transforms.json")
    by_name = {view.name.split("/")[-1]: view for view in project}
    assert set(by_name) == {"view_0.png", "view_2.png", "view_4.png"}
    for name in ("view_0.png", "view_2.png"):
        np.testing.assert_allclose(
            by_name[name].camera.cam_from_world, scene[name].camera.cam_from_world, atol=1e-12
        )
        np.testing.assert_array_equal(by_name[name].load().rgb, scene[name].load().rgb)
    np.testing.assert_allclose(
        by_name["view_4.png"].camera.cam_from_world,
        scene["view_4.png"].camera.cam_from_world,
        atol=1e-12,
    )
    frames = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
    assert [frame.get("generated", False) for frame in frames] == [False, False, True]


def test_glb_is_what_trimesh_reads(memory, saved, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    export_run(saved, "glb", tmp_path / "cloud.glb", *Y_UP)
    scene = trimesh.load_scene(tmp_path / "cloud.glb")
    (cloud,) = scene.dump()
    kept = thin(memory, None)
    np.testing.assert_allclose(cloud.vertices, memory.positions[kept.rows], atol=1e-6)
    colors, material = glb_colors(tmp_path / "cloud.glb")
    np.testing.assert_array_equal(colors, memory.columns.colors[kept.rows])
    linear = 255 * glb_colors(tmp_path / "cloud.glb", linear=True)[0]
    np.testing.assert_allclose(cloud.colors[:, :3], linear, atol=1)
    assert "KHR_materials_unlit" in material["extensions"]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0


@pytest.mark.parametrize("kind", [name for name, form in FORMATS.items() if form.needs])
def test_an_absent_package_is_named_with_what_to_install(saved, tmp_path, monkeypatch, kind):
    form = FORMATS[kind]
    for package in form.needs:
        monkeypatch.setitem(sys.modules, package, None)
    out = tmp_path / f"out{next(iter(form.suffixes))}"
    with pytest.raises(OptionError, match=rf"{form.needs[0]}.*pip install 'gvtools\[export\]'"):
        export_run(saved, kind, out)
    assert not out.exists()


@pytest.mark.parametrize("kind", [name for name, form in FORMATS.items() if form.suffixes])
def test_another_suffix_is_refused(saved, tmp_path, kind):
    with pytest.raises(OptionError, match=f"ends with {next(iter(FORMATS[kind].suffixes))}"):
        export_run(saved, kind, tmp_path / "out.jpg")
    assert not (tmp_path / "out.jpg").exists()


def test_a_view_fused_twice_is_one_camera(scene, tmp_path):
    fused(scene, [0, 0, 2]).save(tmp_path / "memory.npz")
    export_run(tmp_path / "memory.npz", "colmap", tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert sorted(i.name for i in model.images.values()) == ["view_0.png", "view_2.png"]


def test_options_that_make_no_sense(saved, tmp_path):
    with pytest.raises(OptionError, match="--max-points 0; expected at least 1"):
        export_run(saved, "ply", tmp_path / "a.ply", "--max-points", 0)
    with pytest.raises(OptionError, match="transforms does not take it"):
        export_run(saved, "transforms", tmp_path / "a", "--max-points", 5)
    with pytest.raises(OptionError, match=r"las does not take it \(mesh do"):
        export_run(saved, "las", tmp_path / "a.las", "--voxel", 0.1)
    for option, value in (("--voxel", 0), ("--voxel", "nan"), ("--max-triangles", 0)):
        with pytest.raises(OptionError, match="expected"):
            export_run(saved, "mesh", tmp_path / "a.ply", option, value)


@pytest.mark.parametrize("kind", ["colmap", "transforms", "mesh"])
def test_a_ply_has_no_cameras_to_export(memory, tmp_path, kind):
    export_memory_ply(memory, tmp_path / "cloud.ply")
    with pytest.raises(OptionError, match="a PLY, which holds no cameras"):
        export_run(tmp_path / "cloud.ply", kind, tmp_path / "out.ply")
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize("kind", FORMATS)
def test_a_target_that_cannot_be_written(saved, tmp_path, kind):
    for package in FORMATS[kind].needs:
        pytest.importorskip(package)
    out = tmp_path / f"out{next(iter(FORMATS[kind].suffixes), '')}"
    if kind == "colmap":
        out.write_text("in the way")
    else:
        name = out / "transforms.json" if kind == "transforms" else out
        (name / "in the way").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ProjectError, match=r"written"):
        export_run(saved, kind, out)
    assert sorted(tmp_path.rglob("*")) == before


def test_files_that_are_no_export_and_the_input_itself_are_kept(saved, tmp_path):
    memory = saved / "memory.npz"
    before = memory.read_bytes()
    for form, out, text in (
        ("ply", memory, "ends with .ply"),
        ("glb", tmp_path / "photo.jpg", "ends with .glb"),
        ("ply", tmp_path, "ends with .ply"),
    ):
        with pytest.raises(OptionError, match=text):
            export_run(saved, form, out)
    (tmp_path / "mine.ply").write_text("notes")
    with pytest.raises(OptionError, match="no PLY file"):
        export_run(saved, "ply", tmp_path / "mine.ply")
    assert (tmp_path / "mine.ply").read_text() == "notes"
    assert memory.read_bytes() == before
    export_run(saved, "ply", tmp_path / "one.ply")
    export_run(saved, "ply", tmp_path / "one.ply", "--max-points", 50)
    with pytest.raises(OptionError, match="the input"):
        export_run(tmp_path / "one.ply", "ply", tmp_path / "one.ply")
