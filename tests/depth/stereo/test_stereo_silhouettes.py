"""Depth cut back to outlines and grown again: pictures whose outlines are known."""

from __future__ import annotations

import numpy as np
import pytest
from stereo_scenes import plane_scene

from gvtools.depth.options import StereoOptions
from gvtools.depth.stereo.filtering import ALIKE, ROUNDS, regrown, trimmed
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo

ROOF, SKY = 60, 230


def roof(rim: int) -> tuple[np.ndarray, np.ndarray]:
    """A dark roof under a bright sky; depth reaches ``rim`` pixels past the outline."""
    rgb = np.full((60, 60, 3), SKY, np.uint8)
    rgb[30:] = ROOF
    depth = np.zeros((60, 60), np.float32)
    depth[30 - rim :] = 2.0
    return depth, rgb


def plain_trimmed(depth: np.ndarray, rgb: np.ndarray, radius: int) -> np.ndarray:
    """What ``trimmed`` is documented to do, pixel by pixel."""
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


@pytest.mark.parametrize("rim", [1, 2, 3, 4])
def test_a_rim_in_the_sky_goes_and_the_roof_stays(rim):
    depth, rgb = roof(rim)
    clean = trimmed(depth, rgb, 5)
    assert (clean[:30] == 0).all()
    assert (clean[30:] == 2).all()


def test_depth_of_a_whole_wall_stays_round_a_hole():
    rgb = np.full((60, 60, 3), 128, np.uint8)
    depth = np.full((60, 60), 2.0, np.float32)
    depth[20:30, 20:30] = 0
    np.testing.assert_array_equal(trimmed(depth, rgb, 5), depth)


def test_compiled_trimming_equals_the_plain_one():
    rng = np.random.default_rng(0)
    rgb = np.repeat(np.repeat(rng.integers(0, 80, (6, 8, 3)), 5, 0), 5, 1).astype(np.uint8)
    depth = np.where(rng.uniform(size=(30, 40)) < 0.55, 2.0, 0.0).astype(np.float32)
    clean = trimmed(depth, rgb, 3)
    assert 0 < (clean > 0).sum() < (depth > 0).sum()
    np.testing.assert_array_equal(clean, plain_trimmed(depth, rgb, 3))


def test_growth_stops_at_colour_at_depth_and_after_its_steps():
    _, rgb = roof(0)
    seed = np.zeros((60, 60), np.float32)
    seed[45, 10] = 2.0
    candidates = np.full((60, 60), 2.0, np.float32)
    candidates[:, 40:] = 3.0
    grown = regrown(seed, candidates, rgb, 0.03, 1000)
    assert (grown[30:, :40] == 2).all()
    assert (grown[:30] == 0).all() and (grown[:, 40:] == 0).all()
    near = regrown(seed, candidates, rgb, 0.03, 7)
    y, x = np.mgrid[0:60, 0:60]
    np.testing.assert_array_equal(near > 0, np.abs(y - 45) + np.abs(x - 10) <= 7)


def test_growth_takes_candidates_only_and_changes_nothing_known():
    rng = np.random.default_rng(1)
    rgb = np.full((40, 40, 3), 90, np.uint8)
    depth = np.where(rng.uniform(size=(40, 40)) < 0.2, 2.0, 0.0).astype(np.float32)
    candidates = np.where(rng.uniform(size=(40, 40)) < 0.5, 2.02, 0.0).astype(np.float32)
    grown = regrown(depth, candidates, rgb, 0.03, 5)
    np.testing.assert_array_equal(grown[depth > 0], depth[depth > 0])
    new = (grown > 0) & (depth == 0)
    assert new.any()
    np.testing.assert_array_equal(grown[new], candidates[new])


def test_growth_fills_what_no_view_confirms_and_leaves_blank_surfaces_unknown():
    made = plane_scene(blank=True)
    scene, view = made.scene, made.scene["v2"]
    options = StereoOptions(levels=2, align=False, speckle=20, tolerance=0.004)
    known = {}
    for regrow in (0, 20):
        chosen = options.replaced(regrow=regrow)
        stereo = PlaneSweepStereo(scene, options=chosen, views=scene.names)
        known[regrow] = stereo.depth(scene, view, view.load()).depth
    x = view.camera.centers[0, 0] + made.depths[2] * view.camera.rays()[..., 0]
    textured = x < 0.15
    assert (known[20][textured] > 0).mean() > (known[0][textured] > 0).mean()
    assert (known[20][x > 0.45] == 0).mean() > 0.98
    new = (known[20] > 0) & (known[0] == 0) & textured
    error = np.abs(known[20][new] / made.depths[2][new] - 1)
    assert np.median(error) < 0.02
