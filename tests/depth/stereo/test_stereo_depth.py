"""Plane-sweep stereo as a depth source, its clean-up and its confidence."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import ndimage
from stereo_scenes import niche_depth, niche_scene, plane_scene, turning_scene
from tiny_scan import in_another_unit

from gvtools.depth.options import StereoOptions
from gvtools.depth.source import DepthMap
from gvtools.depth.stereo.filtering import (
    ALIKE,
    ROUNDS,
    enlarge,
    regrow,
    remove_speckles,
    trim_outlines,
    weighted_median,
)
from gvtools.depth.stereo.geometry import DepthRange, baselines
from gvtools.depth.stereo.matching import CLEAR, detail_of, noise_of, textured
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo, enough_disparity
from gvtools.errors import DegenerateError
from gvtools.scenes.scene import Frame, Scene, View

OPTIONS = StereoOptions(levels=2, align=False, speckle=20)


@pytest.fixture(scope="module")
def slanted():
    return plane_scene(slope=(0.25, -0.15))


def swept(
    scene: Scene, name: str = "v2", *, views: Sequence[str] = (), **options: Any
) -> tuple[DepthMap, PlaneSweepStereo]:
    """The depth of one view, all views being sources unless some are named."""
    views = tuple(views) or scene.names
    stereo = PlaneSweepStereo(scene, options=OPTIONS.replaced(**options), views=views)
    return stereo.depth(scene, scene[name], scene[name].load()), stereo


def error_and_share(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    known = found > 0
    return float(np.median(np.abs(found[known] / truth[known] - 1))), float(known.mean())


def test_a_slanted_plane_is_measured_but_for_masked_pixels(slanted):
    scene = slanted.scene
    found, stereo = swept(scene)
    error, share = error_and_share(found.depth, slanted.depths[2])
    assert error < 0.005
    assert share > 0.8
    assert found.source == "plane-sweep"
    assert found.depth.dtype == found.confidence.dtype == np.float32
    assert (found.confidence > 0).all() and (found.confidence <= 1).all()
    frame = scene["v2"].load()
    mask = np.ones(frame.rgb.shape[:2], bool)
    mask[:60] = False
    found = stereo.depth(scene, scene["v2"], replace(frame, mask=mask))
    assert (found.depth[:60] == 0).all()
    assert (found.depth[60:] > 0).mean() > 0.7


def test_other_views_are_never_looked_at(slanted):
    def forbidden() -> Frame:
        raise AssertionError("a held-out picture was read")

    scene = slanted.scene
    held_out = replace(scene.views[3], load=forbidden)
    scene = replace(scene, views=(*scene.views[:3], held_out, scene.views[4]))
    found, _ = swept(scene, views=("v0", "v1", "v2", "v4"), align=True)
    assert (found.depth > 0).mean() > 0.5


def test_a_view_outside_the_pool_gets_depth_but_gives_none(slanted):
    scene = slanted.scene
    found, stereo = swept(scene, views=("v0", "v1", "v3", "v4"))
    error, share = error_and_share(found.depth, slanted.depths[2])
    assert error < 0.005 and share > 0.8
    assert all("v2" not in stereo.raw(scene[name]).sources for name in stereo.views)


@pytest.mark.slow
def test_reduced_pictures_give_depth_at_full_size(slanted):
    found, _ = swept(slanted.scene, max_side=96)
    assert found.depth.shape == (120, 160)
    error, share = error_and_share(found.depth, slanted.depths[2])
    assert error < 0.01 and share > 0.7


def test_speckles_go_and_surfaces_stay():
    depth = np.full((40, 40), 2.0, np.float32)
    depth[10:13, 10:13] = 1.0
    depth[:, 20] = 0
    kept = remove_speckles(depth, 0.03, 20)
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
    large, trust = enlarge(depth, flat, fine, np.full_like(depth, 0.7))
    yy, xx = np.mgrid[0:40, 0:60] + 0.5
    expected = 2 + 0.01 * xx / 2 + 0.02 * yy / 2
    np.testing.assert_allclose(large[2:-2, 2:-2], expected[2:-2, 2:-2], atol=1e-4)
    np.testing.assert_allclose(trust[2:-2, 2:-2], 0.7, atol=1e-5)
    depth[:, 15:] = 9.0
    depth[5:10, 5:10] = 0
    large, _ = enlarge(depth, flat, fine, np.ones_like(depth))
    assert not ((large > 3.5) & (large < 8.9)).any()
    assert (large[10:20, 10:20] == 0).all()


def test_a_view_that_shares_nothing_is_refused_and_stops_no_other(slanted):
    scene = slanted.scene
    away = scene.views[4].camera.cam_from_world.copy()
    away[0] = np.diag([-1.0, 1, -1, 1]) @ away[0]
    lost = replace(scene.views[4], camera=replace(scene.views[4].camera, cam_from_world=away))
    scene = replace(scene, views=(*scene.views[:4], lost))
    found, stereo = swept(scene, "v1", align=True)
    assert (found.depth > 0).mean() > 0.5
    with pytest.raises(DegenerateError, match="shows what v4 does"):
        stereo.depth(scene, lost, lost.load())


ROOF, SKY = 60, 230


def roof(rim: int) -> tuple[np.ndarray, np.ndarray]:
    """A dark roof under a bright sky; depth reaches ``rim`` pixels past the outline."""
    rgb = np.full((60, 60, 3), SKY, np.uint8)
    rgb[30:] = ROOF
    depth = np.zeros((60, 60), np.float32)
    depth[30 - rim :] = 2.0
    return depth, rgb


def plain_trimmed(depth: np.ndarray, rgb: np.ndarray, radius: int) -> np.ndarray:
    """What ``trim_outlines`` is documented to do, pixel by pixel."""
    height, width = depth.shape
    for _ in range(ROUNDS):
        kept = depth.copy()
        for y, x in zip(*np.nonzero(depth > 0), strict=True):
            balance = -1.0
            for ny in range(max(0, y - radius), min(height, y + radius + 1)):
                for nx in range(max(0, x - radius), min(width, x + radius + 1)):
                    if (ny - y + nx - x) % 2 == 0:
                        apart = np.abs(rgb[ny, nx].astype(int) - rgb[y, x].astype(int)).max()
                        vote = np.exp(-apart / 255 / ALIKE)
                        balance += -vote if depth[ny, nx] > 0 else vote
            if balance > 0:
                kept[y, x] = 0
        depth = kept
    return depth


@pytest.mark.parametrize("rim", [1, 4])
def test_a_rim_in_the_sky_goes_and_the_roof_stays(rim):
    depth, rgb = roof(rim)
    clean = trim_outlines(depth, rgb, 5)
    assert (clean[:30] == 0).all()
    assert (clean[30:] == 2).all()


def test_compiled_trimming_equals_the_plain_one():
    rng = np.random.default_rng(0)
    rgb = np.repeat(np.repeat(rng.integers(0, 80, (6, 8, 3)), 5, 0), 5, 1).astype(np.uint8)
    depth = np.where(rng.uniform(size=(30, 40)) < 0.55, 2.0, 0.0).astype(np.float32)
    clean = trim_outlines(depth, rgb, 3)
    assert 0 < (clean > 0).sum() < (depth > 0).sum()
    np.testing.assert_array_equal(clean, plain_trimmed(depth, rgb, 3))


def test_growth_stops_at_colour_at_depth_and_after_its_steps():
    _, rgb = roof(0)
    seed = np.zeros((60, 60), np.float32)
    seed[45, 10] = 2.0
    candidates = np.full((60, 60), 2.0, np.float32)
    candidates[:, 40:] = 3.0
    grown = regrow(seed, candidates, rgb, 0.03, 1000)
    assert (grown[30:, :40] == 2).all()
    assert (grown[:30] == 0).all() and (grown[:, 40:] == 0).all()
    near = regrow(seed, candidates, rgb, 0.03, 7)
    y, x = np.mgrid[0:60, 0:60]
    np.testing.assert_array_equal(near > 0, np.abs(y - 45) + np.abs(x - 10) <= 7)


def test_growth_fills_what_no_view_confirms_and_leaves_blank_surfaces_unknown():
    made = plane_scene(blank=True)
    scene, view = made.scene, made.scene["v2"]
    known = {n: swept(scene, tolerance=0.004, regrow=n)[0].depth for n in (0, 20)}
    x = view.camera.centers[0, 0] + made.depths[2] * view.camera.rays()[..., 0]
    textured = x < 0.15
    assert (known[20][textured] > 0).mean() > (known[0][textured] > 0).mean()
    assert (known[20][x > 0.45] == 0).mean() > 0.98
    new = (known[20] > 0) & (known[0] == 0) & textured
    error = np.abs(known[20][new] / made.depths[2][new] - 1)
    assert np.median(error) < 0.02


@pytest.mark.parametrize(
    ("shading", "noise"), [("bowl", 0.006), pytest.param("ramp", 0.0, marks=pytest.mark.slow)]
)
def test_shaded_walls_are_not_guessed(shading, noise):
    scene = niche_scene(shading, noise)
    known = swept(scene, levels=3, speckle=100)[0].depth
    truth, inside = niche_depth(scene["v2"].camera)
    back = ndimage.binary_erosion(inside, iterations=5)
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
    for scene in (turning_scene(1e-7), turning_scene(1e-9, at=(4e6, 5e5, 100.0))):
        with pytest.raises(DegenerateError, match="two viewpoints"):
            swept(scene, "v1", align=align)


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
    scene = plane_scene(count=3).scene
    same = View("again", scene["v1"].camera, scene["v1"].load)
    scene = Scene(scene.root, scene.kind, (*scene.views, same))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, stereo = swept(scene, "v1")
    assert "again" not in stereo.raw(scene["v1"]).sources
    assert (found.depth > 0).mean() > 0.8


@pytest.mark.parametrize("scale", [1e-6, 1e9])
def test_depth_follows_the_scene_units(scale):
    made = plane_scene(slope=(0.25, -0.15), count=3)
    depth = swept(in_another_unit(made.scene, scale), "v1")[0].depth
    known = depth > 0
    assert known.mean() > 0.7
    assert np.median(np.abs(depth[known] / (scale * made.depths[1][known]) - 1)) < 0.005
