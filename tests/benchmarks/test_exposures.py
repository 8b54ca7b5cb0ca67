from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from stereo_scenes import plane_scene

from benchmarks.exposures import estimate_exposures
from benchmarks.reliability import reliability
from gvtools.depth.source import DepthMap
from gvtools.errors import DegenerateError, ShapeError
from gvtools.scenes.scene import Frame, Scene

GAINS = np.array([[1.0, 1.0, 1.0], [0.7, 0.75, 0.8], [1.2, 1.1, 1.0], [0.9, 1.0, 1.1], [1, 0.8, 1]])


def exposed(gains: np.ndarray = GAINS, *, damaged: float = 0.0):
    """Five views of a plane, each times its factors, and their true depth.

    ``damaged`` is the share of each picture that shows something else altogether.
    """
    made = plane_scene(slope=(0.2, 0.1))
    views, depths = [], {}
    for i, (view, gain) in enumerate(zip(made.scene, gains, strict=True)):
        rgb = 40 + 0.5 * view.load().rgb.astype(float)
        rgb[:, : round(damaged * rgb.shape[1])] = 50 + 30 * i
        shown = np.clip(np.round(rgb * gain), 0, 255).astype(np.uint8)
        views.append(replace(view, load=partial(Frame, shown)))
        depth = made.depths[i].astype(np.float32)
        depths[view.name] = DepthMap(depth, np.ones_like(depth), "truth")
    return Scene(made.scene.root, "colmap", tuple(views)), depths


def normalised(gains: np.ndarray) -> np.ndarray:
    return gains / np.exp(np.log(gains).mean(axis=0))


@pytest.mark.parametrize("damaged", [0.0, 0.15])
def test_gains_are_found(damaged):
    scene, depths = exposed(damaged=damaged)
    found = estimate_exposures(scene, depths)
    np.testing.assert_allclose(found.gain, normalised(1 / GAINS), rtol=0.02)


def test_common_colours_agree_and_come_back_at_the_cameras_own_place():
    scene, depths = exposed()
    found = estimate_exposures(scene, depths)
    means = np.array([found.common(view.load().rgb, view.name).mean((0, 1)) for view in scene])
    before = np.array([view.load().rgb.mean((0, 1)) for view in scene])
    assert np.ptp(means, axis=0).max() < 0.3 * np.ptp(before, axis=0).max()
    own = scene.views[1]
    rgb = own.load().rgb
    back = found.as_taken_at(found.common(rgb, own.name), own.camera)
    assert np.abs(back.astype(int) - rgb).max() <= 1


def test_views_without_depth_are_never_looked_at():
    def forbidden() -> Frame:
        raise AssertionError("a held-out picture was read")

    scene, depths = exposed()
    scene = replace(scene, views=(*scene.views[:4], replace(scene.views[4], load=forbidden)))
    del depths["v4"]
    assert estimate_exposures(scene, depths).gain.shape == (4, 3)
    with pytest.raises(DegenerateError, match="0 views"):
        estimate_exposures(scene, {})


def test_reliability_of_a_calibrated_claim_is_near_zero():
    rng = np.random.default_rng(0)
    claimed = rng.uniform(0, 1, 40_000)
    right = rng.uniform(0, 1, 40_000) < claimed
    assert reliability(claimed, right).error < 0.02
    assert reliability(claimed, np.zeros(40_000, bool)).error == pytest.approx(0.5, abs=0.01)
    with pytest.raises(ShapeError, match="as many"):
        reliability([0.5], [])
