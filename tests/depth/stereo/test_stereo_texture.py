"""What cannot be measured is not guessed: shading, noise, a camera that only turned."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from stereo_scenes import niche_depth, niche_scene, plane_scene, turning_scene

from gvtools.depth.options import StereoOptions
from gvtools.depth.stereo.geometry import DepthRange, baselines
from gvtools.depth.stereo.matching import CLEAR, detail_of, noise_of, textured
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.depth.stereo.single_view import enough_disparity
from gvtools.errors import DegenerateError
from gvtools.scenes.scene import Scene, View

OPTIONS = StereoOptions(levels=2, speckle=20)


# One pair of shading and noise; the others with --runslow.
@pytest.mark.parametrize(
    ("shading", "noise"),
    [("bowl", 0.006)]
    + [
        pytest.param(*pair, marks=pytest.mark.slow)
        for pair in (("ramp", 0.0), ("ramp", 0.006), ("bowl", 0.0))
    ],
)
def test_shaded_walls_are_not_guessed(shading, noise):
    scene = niche_scene(shading, noise)
    view = scene["v2"]
    stereo = PlaneSweepStereo(scene, options=StereoOptions(align=False), views=scene.names)
    known = stereo.depth(scene, view, view.load()).depth
    truth, inside = niche_depth(view.camera)
    back = ndimage.binary_erosion(inside, iterations=8)
    assert (known[back] > 0).mean() < 0.05
    wall = ~inside
    assert (known[wall] > 0).mean() >= 0.9
    assert np.median(np.abs(known[wall & (known > 0)] / 2 - 1)) < 0.005
    assert truth[back].min() == 3


def test_detail_is_what_a_fitted_plane_leaves():
    rng = np.random.default_rng(0)
    image = rng.uniform(size=(20, 24)).astype(np.float32)
    found = detail_of(torch.from_numpy(image), 7).numpy()
    y, x = np.mgrid[-3:4, -3:4]
    terms = np.stack([np.ones(49), x.ravel(), y.ravel()], axis=1)
    for row, column in ((3, 3), (9, 12), (16, 20)):
        values = image[row - 3 : row + 4, column - 3 : column + 4].ravel().astype(np.float64)
        left = values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]
        assert found[row, column] == pytest.approx(np.sqrt((left**2).mean()), rel=1e-4)


def test_a_slope_is_no_detail_and_noise_no_texture():
    y, x = np.mgrid[0:80, 0:100]
    rng = np.random.default_rng(1)
    slope = 0.2 + 0.005 * x + 0.002 * y
    for noise in (0.002, 0.006):
        image = torch.from_numpy(slope + rng.normal(0, noise, x.shape)).float()
        image[:, 60:] += 0.1 * ((torch.arange(40) % 4) < 2)
        found = noise_of(image, detail_of(image, 7))
        assert 0.7 * noise < found < noise
        inner = textured(image, window=7, noise=0.001)[5:-5]
        assert inner[:, 5:50].float().mean() < 0.25  # a quarter above what 2 % stay below
        assert inner[:, 65:95].all()
    clean = torch.from_numpy(slope).float()
    assert not textured(clean, window=7, noise=0.003)[5:-5, 5:-5].any()
    assert CLEAR > 1


@pytest.mark.parametrize("align", [None, False])
def test_a_turning_camera_is_refused(align):
    options = OPTIONS.replaced(align=align)
    for scene in (turning_scene(1e-7), turning_scene(1e-9, at=(4e6, 5e5, 100.0))):
        stereo = PlaneSweepStereo(scene, options=options, views=scene.names)
        with pytest.raises(DegenerateError, match="two viewpoints"):
            stereo.depth(scene, scene["v1"], scene["v1"].load())


def test_a_baseline_is_told_from_the_rounding_of_its_coordinates():
    tiny = turning_scene(1e-7)
    np.testing.assert_allclose(baselines(tiny, "v0"), 1e-7 * np.arange(4), rtol=1e-6)
    far = turning_scene(1e-9, at=(4e6, 5e5, 100.0))
    assert (baselines(far, "v0") == 0).all()
    step = turning_scene(1e-3, at=(4e6, 5e5, 100.0))
    np.testing.assert_allclose(baselines(step, "v0"), 1e-3 * np.arange(4), rtol=1e-4)


def test_half_a_pixel_of_disparity_is_needed():
    cameras = plane_scene(turns=False).scene.cameras
    # v3 stands 0.12 beside v2: 150 pixels x 0.12 / depth.
    for depth, enough in ((30.0, True), (44.0, False)):
        depths = DepthRange(depth, 2 * depth, depth, 2 * depth, "points")
        assert bool(enough_disparity(cameras[2], cameras[[3]], depths)[0]) == enough


def test_views_at_one_place_are_no_sources_and_warn_of_nothing():
    scene = plane_scene().scene
    same = View("again", scene["v2"].camera, scene["v2"].load)
    scene = Scene(scene.root, scene.kind, (*scene.views, same))
    stereo = PlaneSweepStereo(scene, options=OPTIONS.replaced(align=False), views=scene.names)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = stereo.depth(scene, scene["v2"], scene["v2"].load())
    assert "again" not in stereo.raw(scene["v2"]).sources
    assert (found.depth > 0).mean() > 0.8


@pytest.mark.parametrize("scale", [1e-6, 1e9])
def test_depth_follows_the_scene_units(scale):
    made = plane_scene(slope=(0.25, -0.15), count=3)
    views = []
    for view in made.scene:
        pose = view.camera.cam_from_world.copy()
        pose[:, :3, 3] *= scale
        views.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))
    scene = replace(made.scene, views=tuple(views))
    stereo = PlaneSweepStereo(scene, options=OPTIONS.replaced(align=False), views=scene.names)
    depth = stereo.depth(scene, scene["v1"], scene["v1"].load()).depth
    known = depth > 0
    assert known.mean() > 0.7
    assert np.median(np.abs(depth[known] / (scale * made.depths[1][known]) - 1)) < 0.005
