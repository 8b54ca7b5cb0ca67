from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from export_runs import export_run
from plain_splats import draw, read_splats
from plyfile import PlyData
from reference_gaussians import rotations

from gvtools.errors import OptionError
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.thinning import thin
from gvtools.runs.run import load_appearance
from pipelines.rendering import render_view


def psnr(one: np.ndarray, two: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(one - two).mean()))


def drawn(splats, camera):
    size = (int(camera.width[0]), int(camera.height[0]))
    return draw(splats, camera.cam_from_world[0], camera.K[0], size=size)


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
