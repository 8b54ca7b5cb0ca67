from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvtools.errors import ShapeError
from gvtools.similarity import align_depth_scale, align_poses, fit_similarity


def _points(seed: int, count: int = 12) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, 3)) * (3, 2, 1)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(1e-3, 1e3), st.integers(3, 30))
def test_a_similarity_is_found_again(seed, scale, count):
    rng = np.random.default_rng(seed)
    source = rng.standard_normal((count, 3))
    rotation = Rotation.random(rng=rng).as_matrix()
    translation = 10 * rng.standard_normal(3)
    fit = fit_similarity(source, scale * source @ rotation.T + translation)
    if not fit.ok:
        assert "collinear" in fit.status
        return
    assert fit.scale == pytest.approx(scale, rel=1e-8)
    np.testing.assert_allclose(fit.rotation, rotation, atol=1e-6)
    np.testing.assert_allclose(fit.translation, translation, atol=1e-7 * max(1, scale))
    assert fit.rmse < 1e-8 * max(1, scale)


def test_noisy_fits_agree_with_pycolmap():
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(3)
    source = _points(3)
    rotation = Rotation.random(rng=rng).as_matrix()
    target = 2.5 * source @ rotation.T + (1, -2, 3) + 0.1 * rng.standard_normal(source.shape)
    fit = fit_similarity(source, target)
    other = pycolmap.estimate_sim3d(source, target)
    assert fit.scale == pytest.approx(other.scale, rel=1e-10)
    np.testing.assert_allclose(fit.rotation, other.rotation.matrix(), atol=1e-10)
    np.testing.assert_allclose(fit.translation, other.translation, atol=1e-9)
    assert np.linalg.det(fit.rotation) == pytest.approx(1)


@pytest.mark.parametrize("planar", [False, True])
def test_a_rigid_fit_agrees_with_scipy_and_keeps_the_scale(planar):
    rng = np.random.default_rng(4)
    source = _points(4) * (1, 1, 0 if planar else 1)
    target = source @ Rotation.random(rng=rng).as_matrix().T + 0.1 * rng.standard_normal((12, 3))
    weights = rng.random(12)
    fit = fit_similarity(source, target, with_scale=False, weights=weights)
    share = weights / weights.sum()
    other, _ = Rotation.align_vectors(
        target - share @ target, source - share @ source, weights=weights
    )
    assert fit.scale == 1
    np.testing.assert_allclose(fit.rotation, other.as_matrix(), atol=1e-7)


def test_large_offsets_keep_millimetres():
    rng = np.random.default_rng(7)
    source = rng.standard_normal((20, 3)) * 20
    rotation = Rotation.random(rng=rng).as_matrix()
    utm = np.array([6.9e5, 5.3e6, 400.0])
    target = 0.37 * source @ rotation.T + utm
    fit = fit_similarity(source, target)
    assert np.abs(fit.apply(source) - target).max() < 1e-8
    back = fit_similarity(target, source)
    assert np.abs(back.apply(target) - source).max() < 1e-7
    formula = back.scale * target @ back.rotation.T + back.translation
    assert np.abs(formula - source).max() < 1e-6


def test_shapes_and_values_are_checked():
    points = _points(0)
    with pytest.raises(ShapeError, match=r"both \(N, 3\)"):
        fit_similarity(points, points[:-1])
    with pytest.raises(ShapeError, match="weights"):
        fit_similarity(points, points, weights=-np.ones(12))
    points[3, 1] = np.nan
    with pytest.raises(ShapeError, match="NaN"):
        fit_similarity(points, points)


def _depths(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    reference = rng.uniform(1, 5, (40, 50))
    return reference / 1.7 * np.exp(0.01 * rng.standard_normal(reference.shape)), reference


def test_a_scale_survives_forty_percent_of_wrong_pixels():
    depth, reference = _depths()
    wrong = np.random.default_rng(1).random(depth.shape) < 0.4
    depth[wrong] *= 1.6
    fit = align_depth_scale(depth, reference, valid=np.ones(depth.shape, bool))
    assert fit.ok
    assert fit.scale == pytest.approx(1.7, rel=2e-3)
    assert fit.inlier_share == pytest.approx((~wrong).mean(), abs=0.02)
    # The plain mean of ratios, for comparison, is far off.
    assert abs(np.mean(reference / depth) / 1.7 - 1) > 0.1


def test_exact_depths_give_the_exact_scale_and_it_multiplies():
    _, reference = _depths()
    fit = align_depth_scale(reference / 3, reference, valid=np.ones(reference.shape, bool))
    assert fit.scale == pytest.approx(3, rel=1e-9)
    assert fit.inliers == fit.support == reference.size
    assert fit.residual < 1e-9


def test_only_common_finite_pixels_count():
    depth, reference = _depths()
    valid = np.ones(depth.shape, bool)
    valid[:10] = False
    depth[:10] *= 9
    depth[10, :3] = (np.nan, np.inf, 0)
    reference[11, :2] = (0, np.nan)
    confidence = np.ones(depth.shape)
    confidence[12, 0] = 0
    fit = align_depth_scale(depth, reference, valid=valid, confidence=confidence)
    assert fit.support == 30 * 50 - 6
    assert fit.scale == pytest.approx(1.7, rel=2e-3)


def test_confidence_decides_between_two_scales():
    reference = np.full((40, 50), 2.0)
    depth = np.where(np.arange(50) < 30, 1.0, 1.25) * np.ones((40, 1))
    confidence = np.where(np.arange(50) < 30, 0.1, 1.0) * np.ones((40, 1))
    valid = np.ones(depth.shape, bool)
    assert align_depth_scale(depth, reference, valid=valid).scale == pytest.approx(2.0)
    weighted = align_depth_scale(depth, reference, valid=valid, confidence=confidence)
    assert weighted.scale == pytest.approx(1.6)


def test_too_little_overlap_and_too_much_spread_are_refused():
    depth, reference = _depths()
    few = np.zeros(depth.shape, bool)
    few.ravel()[:199] = True
    fit = align_depth_scale(depth, reference, valid=few)
    assert not fit.ok and np.isnan(fit.scale) and "199 common pixels" in fit.status
    scattered = depth * np.random.default_rng(2).uniform(0.3, 3, depth.shape)
    fit = align_depth_scale(scattered, reference, valid=np.ones(depth.shape, bool))
    assert fit.status.startswith("unsupported: ") and np.isnan(fit.scale)
    with pytest.raises(ShapeError, match="one shape"):
        align_depth_scale(depth, reference[1:], valid=few)


def test_poses_are_aligned_by_the_motion_of_their_world():
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = Rotation.random(6, random_state=0).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(6, 3))
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix()
    motion[:3, 3] = [3, -20, 5]
    np.testing.assert_allclose(align_poses(poses, poses @ motion), motion, atol=1e-12)
