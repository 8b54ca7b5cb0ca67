from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gvtools.completers.geoverse.objective import DEFECTS, center_similarity
from gvtools.similarity import fit_similarity

SEEDS = st.integers(0, 2**32 - 1)


def _rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def _fit(predicted, reference):
    return center_similarity(
        torch.as_tensor(np.asarray(predicted))[None], torch.as_tensor(np.asarray(reference))[None]
    )


@settings(deadline=None)
@given(SEEDS, st.integers(2, 8), st.floats(0.01, 100))
def test_a_similarity_is_recovered_from_two_centres_on(seed, count, scale):
    rng = np.random.default_rng(seed)
    points, q, b = rng.normal(size=(count, 3)), _rotation(rng), rng.normal(size=3)
    fit = _fit(points, scale * points @ q.T + b)
    assert fit.status == ("aligned",)
    assert float(fit.scale) == pytest.approx(scale, rel=1e-9)
    assert float(fit.correlation) == pytest.approx(1)
    if count >= 4:
        np.testing.assert_allclose(fit.rotation[0], q, atol=1e-6)
        np.testing.assert_allclose(fit.translation[0], b, atol=1e-6 * (1 + scale))
    assert float(torch.linalg.det(fit.rotation)) == pytest.approx(1)


@settings(deadline=None)
@given(SEEDS, st.integers(3, 8), st.floats(0, 2))
def test_noisy_centres_give_the_scale_of_the_numpy_fit(seed, count, noise):
    rng = np.random.default_rng(seed)
    predicted = rng.normal(size=(count, 3))
    reference = 3 * predicted @ _rotation(rng).T + noise * rng.normal(size=(count, 3)) + 5
    expected = fit_similarity(predicted, reference)
    fit = _fit(predicted, reference)
    if expected.ok:
        assert float(fit.scale) == pytest.approx(expected.scale, rel=1e-9)
        np.testing.assert_allclose(fit.rotation[0], expected.rotation, atol=1e-6)
        np.testing.assert_allclose(fit.translation[0], expected.translation, atol=1e-6)
        spread = reference - reference.mean(axis=0)
        left = (expected.residuals**2).sum() / (spread**2).sum()
        assert 1 - float(fit.correlation) ** 2 == pytest.approx(left, abs=1e-9)


@settings(deadline=None)
@given(SEEDS)
def test_mirrored_centres_are_not_matched_by_a_reflection(seed):
    rng = np.random.default_rng(seed)
    predicted = rng.normal(size=(6, 3))
    reference = 2 * predicted * np.array([-1.0, 1, 1])
    fit = _fit(predicted, reference)
    assert float(torch.linalg.det(fit.rotation)) == pytest.approx(1)
    singular = np.linalg.svd((predicted - predicted.mean(0)).T @ (predicted - predicted.mean(0)))[1]
    expected = 2 * (singular[0] + singular[1] - singular[2]) / singular.sum()
    assert float(fit.scale) == pytest.approx(expected, rel=1e-9)
    assert 0 < float(fit.scale) < 2


def test_centres_on_a_line_give_a_scale_where_the_numpy_fit_refuses():
    line = np.linspace(0, 1, 5)[:, None] * np.array([[1.0, 2.0, -1.0]]) + 3
    reference = 4 * line @ _rotation(np.random.default_rng(0)).T
    assert not fit_similarity(line, reference).ok
    fit = _fit(line, reference)
    assert fit.status == ("aligned",) and float(fit.scale) == pytest.approx(4)


def test_samples_are_fitted_one_by_one_from_their_finite_centres():
    rng = np.random.default_rng(1)
    predicted = rng.normal(size=(3, 6, 3))
    reference = np.array([2.0, 3.0, 5.0])[:, None, None] * predicted + rng.normal(size=(3, 1, 3))
    reference[0, 4:], reference[1, 0], predicted[2, 3] = np.nan, np.nan, np.inf
    fit = center_similarity(torch.tensor(predicted), torch.tensor(reference))
    np.testing.assert_allclose(fit.scale, [2, 3, 5])
    assert fit.used.tolist() == [4, 5, 5]


@pytest.mark.parametrize(
    ("predicted", "reference", "defect"),
    [
        (np.eye(3), np.where(np.arange(3)[:, None] > 0, np.nan, np.eye(3)), 1),
        (np.full((3, 3), np.nan), np.eye(3), 1),
        (np.full((3, 3), 0.1), np.eye(3), 2),
        (np.zeros((3, 3)), np.eye(3), 2),
        (np.eye(3), np.full((3, 3), 1e6 / 3), 3),
        (
            np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 0], [0, 0, 0]]),
            np.array([[0.0, 0, 0], [0, 0, 0], [0, 1, 0], [0, -1, 0]]),
            4,
        ),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_what_leaves_the_scale_open_is_said(predicted, reference, defect, dtype):
    fit = center_similarity(
        torch.tensor(predicted, dtype=dtype)[None], torch.tensor(reference, dtype=dtype)[None]
    )
    assert fit.status == (DEFECTS[defect],)
    assert not bool(fit.ok) and bool(fit.scale.isnan()) and bool(fit.rotation.isnan().all())


def test_small_baselines_far_out_are_geometry_as_long_as_the_dtype_resolves_them():
    rng = np.random.default_rng(0)
    predicted = rng.normal(size=(4, 3)) * 1e-3 + 100
    fine = _fit(predicted, 2 * predicted)
    assert float(fine.scale) == pytest.approx(2, rel=1e-6)
    coarse = _fit(predicted.astype(np.float32) + np.float32(1e5), predicted)
    assert coarse.status == ("coincident predicted centres",)


def test_half_precision():
    points = torch.randn(1, 5, 3, generator=torch.Generator().manual_seed(0))
    fit = center_similarity(points.to(torch.bfloat16), 3 * points)
    assert fit.scale.dtype == torch.float32 and float(fit.scale) == pytest.approx(3, rel=0.01)
