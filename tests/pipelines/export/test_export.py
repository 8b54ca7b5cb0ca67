from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from box_project import fused
from export_runs import Y_UP, export_run, glb_colors
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData
from reference_gaussians import harmonics, rotations
from splat_scene import psnr

from gvtools.cameras import Cameras
from gvtools.errors import OptionError, ProjectError
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.thinning import thin
from gvtools.runs.run import load_appearance
from gvtools.scenes.project import open_project
from pipelines.export.formats import FORMATS
from pipelines.rendering import render_view

NEAR, DILATION, MOST, LEAST = 0.01, 0.3, 0.99, 1 / 255


def read_splats(path: Path) -> dict[str, NDArray[np.float64]]:
    """Positions, sizes, rotations, opacities and harmonics (N, H, 3) of a splat PLY."""
    vertex = PlyData.read(str(path))["vertex"]

    def stacked(*names: str) -> NDArray[np.float64]:
        return np.stack([np.asarray(vertex[name], np.float64) for name in names], axis=1)

    rest = sum(each.name.startswith("f_rest") for each in vertex.properties)
    dc = stacked(*(f"f_dc_{k}" for k in range(3)))[:, None]
    sh = [dc]
    if rest:
        of_channel = stacked(*(f"f_rest_{k}" for k in range(rest))).reshape(len(dc), 3, -1)
        # Readers take 45 coefficients; none above degree 2 is used.
        assert rest == 45 and not of_channel[:, :, 8:].any()
        sh.append(of_channel[:, :, :8].transpose(0, 2, 1))
    return {
        "positions": stacked("x", "y", "z"),
        "sizes": np.exp(stacked(*(f"scale_{k}" for k in range(3)))),
        "rotations": stacked(*(f"rot_{k}" for k in range(4))),
        "opacities": 1 / (1 + np.exp(-np.asarray(vertex["opacity"], np.float64))),
        "harmonics": np.concatenate(sh, axis=1),
    }


def drawn(splats: dict[str, NDArray[np.float64]], camera: Cameras) -> NDArray[np.float64]:
    """(H, W, 3) colours, 0 to 1."""
    size = width, height = int(camera.width[0]), int(camera.height[0])
    K, R, t = camera.K[0], camera.cam_from_world[0, :3, :3], camera.cam_from_world[0, :3, 3]
    points = splats["positions"] @ R.T + t
    order = np.argsort(points[:, 2], kind="stable")
    order = order[points[order, 2] > NEAR]
    x, y, z = points[order].T
    xy = np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], axis=1)
    V = _covariances(splats, order, points[order], R=R, K=K, size=size)
    colors = _colors(splats, order, eye=-R.T @ t)
    opacities = splats["opacities"][order]
    image, clear = np.zeros((height, width, 3)), np.ones((height, width))
    reach = np.sqrt(np.maximum(2 * np.log(np.maximum(opacities / LEAST, 1e-9)), 0))[:, None]
    half = reach * np.sqrt(np.stack([V[:, 0, 0], V[:, 1, 1]], axis=1))
    first = np.maximum(np.floor(xy - half), 0).astype(int)
    last = np.minimum(np.ceil(xy + half) + 1, size).astype(int)
    conics = np.linalg.inv(V)
    for i in np.flatnonzero((first < last).all(axis=1) & (opacities > LEAST)):
        columns = np.arange(first[i, 0], last[i, 0]) + 0.5 - xy[i, 0]
        rows = np.arange(first[i, 1], last[i, 1])[:, None] + 0.5 - xy[i, 1]
        a, b, c = conics[i, 0, 0], conics[i, 0, 1], conics[i, 1, 1]
        q = a * columns**2 + 2 * b * columns * rows + c * rows**2
        alpha = np.minimum(opacities[i] * np.exp(-q / 2), MOST)
        alpha[alpha < LEAST] = 0
        where = slice(first[i, 1], last[i, 1]), slice(first[i, 0], last[i, 0])
        image[where] += (clear[where] * alpha)[..., None] * colors[i]
        clear[where] *= 1 - alpha
    return np.clip(image, 0, 1)


def _covariances(splats, order, points, *, R, K, size):
    """(M, 2, 2) in the picture [px^2]."""
    x, y, z = points.T
    ends = [1.3 * side / 2 / f for side, f in zip(size, (K[0, 0], K[1, 1]), strict=True)]
    ux, uy = np.clip(x / z, -ends[0], ends[0]), np.clip(y / z, -ends[1], ends[1])
    J = np.zeros((len(points), 2, 3))
    J[:, 0, 0], J[:, 1, 1] = K[0, 0] / z, K[1, 1] / z
    J[:, 0, 2], J[:, 1, 2] = -J[:, 0, 0] * ux, -J[:, 1, 1] * uy
    turns = rotations(torch.from_numpy(splats["rotations"][order])).numpy()
    M = J @ R @ (turns * splats["sizes"][order][:, None])
    return M @ M.transpose(0, 2, 1) + DILATION * np.eye(2)


def _colors(splats, order, *, eye):
    """(M, 3) as seen from a point."""
    sh = splats["harmonics"][order]
    away = splats["positions"][order] - eye
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    basis = harmonics(torch.from_numpy(away)).numpy()[:, : sh.shape[1]]
    return np.maximum(0.5 + np.einsum("mh,mhc->mc", basis, sh), 0)


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
    for name, view in by_name.items():
        np.testing.assert_allclose(
            view.camera.cam_from_world, scene[name].camera.cam_from_world, atol=1e-12
        )
        if name != "view_4.png":
            np.testing.assert_array_equal(view.load().rgb, scene[name].load().rgb)
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


def test_a_ply_has_no_cameras_to_export(memory, tmp_path):
    export_memory_ply(memory, tmp_path / "cloud.ply")
    for kind in ("colmap", "transforms", "mesh"):
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
    for form, text in (("ply", "notes"), ("html", "<!DOCTYPE html>\n<html>mine</html>")):
        (tmp_path / f"mine.{form}").write_text(text)
        with pytest.raises(OptionError, match=f"no {form.upper()} file of this format"):
            export_run(saved, form, tmp_path / f"mine.{form}")
        assert (tmp_path / f"mine.{form}").read_text() == text
    export_run(saved, "ply", tmp_path / "one.ply")
    export_run(saved, "ply", tmp_path / "one.ply", "--max-points", 50)
    with pytest.raises(OptionError, match="the input"):
        export_run(tmp_path / "one.ply", "ply", tmp_path / "one.ply")


def losses(scene, fitted_run, file):
    """What the file's pictures lose to ``gvtools render`` in two photographs [dB]."""
    splats, appearance = read_splats(file), load_appearance(fitted_run.folder)
    lost = []
    for row in (0, 1):
        view = scene.views[row]
        truth = view.load().rgb / 255
        shown, _ = render_view(
            fitted_run.memory, view.camera, SplatOptions(), appearance=appearance
        )
        lost.append(psnr(shown.rgb[0], truth) - psnr(drawn(splats, view.camera), truth))
    return lost


def test_the_ply_has_inrias_properties_in_order(fitted_run, tmp_path):
    export_run(fitted_run.folder, "splat", tmp_path / "out.ply")
    vertex = PlyData.read(tmp_path / "out.ply")["vertex"]
    names = [each.name for each in vertex.properties]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{k}" for k in range(45)]
    assert names[54:] == ["opacity", "scale_0", "scale_1", "scale_2",
                          "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    assert {each.val_dtype for each in vertex.properties} == {"f4"}
    # Some readers take the third line for the count.
    with (tmp_path / "out.ply").open("rb") as file:
        assert [file.readline().split()[0] for _ in range(3)] == [b"ply", b"format", b"element"]


def test_gsply_reads_fitted_and_generated_gaussians(fitted_run, tmp_path):
    gsply = pytest.importorskip("gsply")
    export_run(fitted_run.folder, "splat", tmp_path / "out.ply")
    read = gsply.plyread(tmp_path / "out.ply")
    made = thin(fitted_run.memory, None, among=fitted_run.memory.generated).rows
    gaussians = fitted_run.appearance.gaussians
    fitted = len(gaussians)
    assert len(read.means) == fitted + len(made) and len(made) > 100
    world = gaussians.frame.to_world(gaussians.values[:, :3])
    np.testing.assert_allclose(read.means[:fitted], world, atol=1e-5)
    np.testing.assert_allclose(read.means[fitted:], fitted_run.memory.positions[made], atol=1e-5)
    np.testing.assert_allclose(read.scales[:fitted], gaussians.values[:, 3:6], atol=1e-6)
    np.testing.assert_allclose(np.ravel(read.opacities)[:fitted], 3, atol=1e-6)
    # Those of the memory: round, of the voxels' size, without harmonics, opaque.
    np.testing.assert_allclose(np.ptp(read.scales[fitted:], axis=1), 0, atol=1e-6)
    assert (np.exp(read.scales[fitted:, 0]) < 2 * fitted_run.memory.voxel).all()
    assert not read.shN[fitted:].any()
    colors = 0.5 + 0.28209479177387814 * read.sh0[fitted:]
    np.testing.assert_allclose(colors * 255, fitted_run.memory.columns.colors[made], atol=1e-2)
    export_run(fitted_run.folder, "splat", tmp_path / "out.ply", "--observed")
    assert len(gsply.plyread(tmp_path / "out.ply").means) == fitted


def test_another_rasteriser_shows_what_render_shows(scene, fitted_run, tmp_path):
    export_run(fitted_run.folder, "splat", tmp_path / "out.ply")
    assert max(losses(scene, fitted_run, tmp_path / "out.ply")) < 1


def test_exposures_are_in_the_colours(scene, fitted_run, tmp_path):
    # All cameras of the box stand in one place, so that directions tell but a part of it.
    export_run(fitted_run.folder, "splat", tmp_path / "out.ply", "--observed")
    splats = read_splats(tmp_path / "out.ply")
    plain = replace(fitted_run.appearance, exposures=None)
    for row in (0, 1):
        camera = scene.views[row].camera
        wanted = fitted_run.appearance.picture(camera).rgb
        assert psnr(drawn(splats, camera), wanted) > psnr(plain.picture(camera).rgb, wanted) + 0.5


def test_a_memory_without_a_fit_shows_its_points(scene, bare_run, tmp_path):
    export_run(bare_run.folder, "splat", tmp_path / "out.ply")
    splats = read_splats(tmp_path / "out.ply")
    assert len(splats["positions"]) == bare_run.memory.voxels
    assert not splats["harmonics"][:, 1:].any()
    # More confidence, more opacity.
    rows = thin(bare_run.memory, None).rows
    order = np.argsort(bare_run.memory.confidence[rows])
    assert (np.diff(splats["opacities"][order]) >= -1e-6).all()
    camera = scene.views[1].camera
    shown = bare_run.memory.project(camera)
    both = shown.valid[0]
    assert psnr(drawn(splats, camera)[both], shown.rgb[0][both]) > 28
    export_run(bare_run.folder, "splat", tmp_path / "out.ply", "--max-points", 300)
    assert 50 < len(read_splats(tmp_path / "out.ply")["positions"]) <= 300


def test_gsply_reads_the_spz_as_the_ply(fitted_run, tmp_path):
    gsply = pytest.importorskip("gsply")
    for form, name in (("splat", "out.ply"), ("spz", "out.spz")):
        export_run(fitted_run.folder, form, tmp_path / name)
    ply, spz = gsply.plyread(tmp_path / "out.ply"), gsply.read_spz(tmp_path / "out.spz")
    assert len(spz.means) == len(ply.means)
    flip = np.array([1, -1, -1])
    step = np.exp(ply.scales.min()) / 8
    np.testing.assert_allclose(spz.means * flip, ply.means, atol=step)
    np.testing.assert_allclose(spz.scales, ply.scales, atol=1 / 32 + 1e-6)
    np.testing.assert_allclose(spz.sh0, ply.sh0, atol=0.5 / 255 / 0.15 + 1e-5)
    opacity = [1 / (1 + np.exp(-np.ravel(each.opacities))) for each in (ply, spz)]
    np.testing.assert_allclose(opacity[1], opacity[0], atol=0.5 / 255 + 1e-5)
    turns = [
        rotations(torch.from_numpy(np.asarray(each.quats, np.float64))).numpy()
        for each in (ply, spz)
    ]
    spread = [(R * np.exp(2.0 * ply.scales[:, None])) @ R.transpose(0, 2, 1) for R in turns]
    spread[1] = flip[:, None] * spread[1] * flip
    np.testing.assert_allclose(spread[1], spread[0], atol=0.02 * np.exp(2 * ply.scales.max()))
    # Degree by degree the signs of half a turn around x.
    signs = np.array([-1, -1, 1, -1, 1, 1, -1, 1])[:, None]
    coefficients = ply.shN[:, :8]
    np.testing.assert_allclose(spz.shN * signs, coefficients, atol=0.5 / 128 + 1e-6)
    assert np.corrcoef((spz.shN * signs).ravel(), coefficients.ravel())[0, 1] > 0.3


def test_equal_exports_are_equal_files(fitted_run, tmp_path):
    for name in ("a.spz", "b.spz"):
        export_run(fitted_run.folder, "spz", tmp_path / name)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def test_fitted_gaussians_are_not_thinned(fitted_run, tmp_path):
    count = len(fitted_run.appearance.gaussians)
    with pytest.raises(OptionError, match=f"the run's fit has {count} Gaussians"):
        export_run(fitted_run.folder, "splat", tmp_path / "out.ply", "--max-points", 10)
    export_run(fitted_run.folder, "splat", tmp_path / "out.ply", "--max-points", count + 40)
    read = len(read_splats(tmp_path / "out.ply")["positions"])
    assert count < read <= count + 40
