"""Plane-sweep stereo as a depth source, its clean-up and its confidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stereo_scenes import plane_scene

from gvtools.depth.options import StereoOptions
from gvtools.depth.source import DepthMap
from gvtools.depth.stereo.filtering import enlarged, weighted_median, without_speckles
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.errors import DegenerateError, OptionError, ProjectError
from gvtools.scenes.scene import Frame, Scene

OPTIONS = StereoOptions(levels=2, align=False, speckle=20)


@pytest.fixture(scope="module")
def slanted():
    return plane_scene(slope=(0.25, -0.15))


def swept(scene: Scene, name: str = "v2", *, options: StereoOptions = OPTIONS) -> DepthMap:
    """The depth of one view, all views being sources."""
    stereo = PlaneSweepStereo(scene, options=options, views=scene.names)
    return stereo.depth(scene, scene[name], scene[name].load())


def error_and_share(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    known = found > 0
    return float(np.median(np.abs(found[known] / truth[known] - 1))), float(known.mean())


def test_a_slanted_plane_is_measured(slanted):
    found = swept(slanted.scene)
    error, share = error_and_share(found.depth, slanted.depths[2])
    assert error < 0.005
    assert share > 0.8
    assert found.source == "plane-sweep"
    assert found.depth.dtype == found.confidence.dtype == np.float32
    assert (found.confidence > 0).all() and (found.confidence <= 1).all()


def test_the_same_twice_and_after_other_views(slanted):
    scene = slanted.scene
    second = PlaneSweepStereo(scene, options=OPTIONS, views=scene.names)
    second.depth(scene, scene["v0"], scene["v0"].load())
    one, two = swept(scene), second.depth(scene, scene["v2"], scene["v2"].load())
    np.testing.assert_array_equal(one.depth, two.depth)
    np.testing.assert_array_equal(one.confidence, two.confidence)


def test_torch_and_compiled_back_ends_agree():
    scene = plane_scene(slope=(0.25, -0.15), count=3).scene
    options = OPTIONS.replaced(device="cpu", sources=2, best=1)
    maps = [
        swept(scene, "v1", options=options.replaced(backend=backend)).depth
        for backend in ("cpu", "torch")
    ]
    both = (maps[0] > 0) & (maps[1] > 0)
    assert ((maps[0] > 0) == (maps[1] > 0)).mean() > 0.99
    assert np.quantile(np.abs(maps[0][both] / maps[1][both] - 1), 0.98) < 2e-3


def test_other_views_are_never_looked_at(slanted):
    def forbidden() -> Frame:
        raise AssertionError("a held-out picture was read")

    scene = slanted.scene
    held_out = replace(scene.views[3], load=forbidden)
    scene = replace(scene, views=(*scene.views[:3], held_out, scene.views[4]))
    names = tuple(name for name in scene.names if name != "v3")
    stereo = PlaneSweepStereo(scene, options=OPTIONS.replaced(align=True), views=names)
    found = stereo.depth(scene, scene["v2"], scene["v2"].load())
    assert (found.depth > 0).mean() > 0.5


def test_a_view_outside_the_pool_gets_depth_but_gives_none(slanted):
    scene = slanted.scene
    stereo = PlaneSweepStereo(scene, options=OPTIONS, views=("v0", "v1", "v3", "v4"))
    found = stereo.depth(scene, scene["v2"], scene["v2"].load())
    error, share = error_and_share(found.depth, slanted.depths[2])
    assert error < 0.005 and share > 0.8
    assert all("v2" not in stereo.raw(scene[name]).sources for name in stereo.views)


def test_blank_surfaces_stay_unknown():
    made = plane_scene(blank=True)
    view = made.scene["v2"]
    found = swept(made.scene)
    rays = view.camera.rays()
    x = view.camera.centers[0, 0] + made.depths[2] * rays[..., 0]
    assert (found.depth[x > 0.45] == 0).mean() > 0.98
    assert (found.depth[x < 0.15] > 0).mean() > 0.8


@pytest.mark.slow
def test_reduced_pictures_give_depth_at_full_size(slanted):
    found = swept(slanted.scene, options=OPTIONS.replaced(max_side=96))
    assert found.depth.shape == (120, 160)
    error, share = error_and_share(found.depth, slanted.depths[2])
    assert error < 0.01 and share > 0.7


def test_masked_pixels_are_left_out(slanted):
    scene = slanted.scene
    frame = scene["v2"].load()
    mask = np.ones(frame.rgb.shape[:2], bool)
    mask[:60] = False
    stereo = PlaneSweepStereo(scene, options=OPTIONS, views=scene.names)
    found = stereo.depth(scene, scene["v2"], replace(frame, mask=mask))
    assert (found.depth[:60] == 0).all()
    assert (found.depth[60:] > 0).mean() > 0.7


def test_errors_name_what_is_wrong(slanted):
    with pytest.raises(OptionError, match="expected at least 2"):
        PlaneSweepStereo(slanted.scene, views=("v0",))
    with pytest.raises(ProjectError, match="nothing"):
        PlaneSweepStereo(slanted.scene, views=("v0", "nothing"))


def test_speckles_go_and_surfaces_stay():
    depth = np.full((40, 40), 2.0, np.float32)
    depth[10:13, 10:13] = 1.0
    depth[:, 20] = 0
    kept = without_speckles(depth, 0.03, 20)
    assert (kept[10:13, 10:13] == 0).all()
    kept[10:13, 10:13] = 1.0
    np.testing.assert_array_equal(kept, depth)


def test_median_removes_outliers_keeps_edges_and_holes():
    depth = np.full((20, 20), 2.0, np.float32)
    depth[:, 10:] = 4.0
    guide = (depth / 4).astype(np.float32)
    noisy = depth.copy()
    noisy[5, 5] = 3.0
    noisy[8, 15] = 0.0
    clean = weighted_median(noisy, guide, np.ones_like(depth), 2)
    assert clean[8, 15] == 0
    clean[8, 15] = 4.0
    np.testing.assert_array_equal(clean, depth)


def test_enlarged_keeps_planes_exact_edges_sharp_and_holes_empty():
    y, x = np.mgrid[0:20, 0:30] + 0.5
    depth = (2 + 0.01 * x + 0.02 * y).astype(np.float32)
    flat, fine = np.full((20, 30), 0.5, np.float32), np.full((40, 60), 0.5, np.float32)
    large, trust = enlarged(depth, flat, fine, np.full_like(depth, 0.7))
    yy, xx = np.mgrid[0:40, 0:60] + 0.5
    expected = 2 + 0.01 * xx / 2 + 0.02 * yy / 2
    np.testing.assert_allclose(large[2:-2, 2:-2], expected[2:-2, 2:-2], atol=1e-4)
    np.testing.assert_allclose(trust[2:-2, 2:-2], 0.7, atol=1e-5)
    depth[:, 15:] = 9.0
    depth[5:10, 5:10] = 0
    large, _ = enlarged(depth, flat, fine, np.ones_like(depth))
    assert not ((large > 3.5) & (large < 8.9)).any()
    assert (large[10:20, 10:20] == 0).all()


def test_a_view_that_shares_nothing_is_refused_and_stops_no_other(slanted):
    scene = slanted.scene
    away = scene.views[4].camera.cam_from_world.copy()
    away[0] = np.diag([-1.0, 1, -1, 1]) @ away[0]
    lost = replace(scene.views[4], camera=replace(scene.views[4].camera, cam_from_world=away))
    scene = replace(scene, views=(*scene.views[:4], lost))
    stereo = PlaneSweepStereo(scene, options=OPTIONS.replaced(align=True), views=scene.names)
    found = stereo.depth(scene, scene["v1"], scene["v1"].load())
    assert (found.depth > 0).mean() > 0.5
    with pytest.raises(DegenerateError, match="shows what v4 does"):
        stereo.depth(scene, lost, lost.load())
