"""Colours from Gaussians and memory together."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.filters import gaussian

from gvtools.appearance.appearance import SHARES, TOLERANCES, Blend, best_blend, blended

SHAPE = (40, 50)


@pytest.fixture(scope="module")
def truth():
    rng = np.random.default_rng(0)
    smooth = gaussian(rng.uniform(0, 1, (*SHAPE, 3)), 4, channel_axis=2)
    fine = 0.1 * rng.standard_normal((*SHAPE, 3))
    return np.clip(0.5 + 3 * (smooth - 0.5) + fine, 0.05, 0.95).astype(np.float32)


@pytest.fixture(scope="module")
def where():
    return np.random.default_rng(1).uniform(size=SHAPE) < 0.9


def soft(picture):
    return gaussian(picture, 2, channel_axis=2).astype(np.float32)


def wrong(picture):
    return (1 - picture).astype(np.float32)


def score(shown, memory, where, truth, blend):
    off = (blended(shown, memory, where, blend=blend) - truth)[where]
    return -10 * np.log10(np.square(off).mean())


def test_the_memory_is_taken_where_gaussians_are_bad(truth, where):
    blend = best_blend([(np.full_like(truth, 0.2), truth, where, truth)])
    assert blend == Blend(1.0, TOLERANCES[-1])


def test_gaussians_are_taken_where_the_memory_is_bad(truth, where):
    assert best_blend([(truth, wrong(truth), where, truth)]).share == 0


def test_detail_is_taken_where_both_agree_and_not_where_the_memory_is_far_off(truth, where):
    memory = truth.copy()
    memory[:, 25:] = wrong(truth)[:, 25:]
    blend = best_blend([(soft(truth), memory, where, truth)])
    assert blend.share == 1
    assert blend.tolerance < TOLERANCES[-1]
    sample = (soft(truth), memory, where, truth)
    mixed = score(*sample, blend)
    assert mixed > score(*sample, Blend(0.0, 1.0)) + 0.5
    assert mixed > score(*sample, Blend(1.0, 1e6)) + 3
    result = blended(soft(truth), memory, where, blend=blend)
    left, right = (slice(None), slice(0, 20)), (slice(None), slice(30, None))
    assert np.abs(result - truth)[left].mean() < 0.6 * np.abs(soft(truth) - truth)[left].mean()
    assert np.abs(result - soft(truth))[right][where[right]].mean() < 0.03


def test_the_best_blend_is_that_of_the_best_mean_psnr(truth, where):
    rng = np.random.default_rng(2)
    noisy = np.clip(truth + 0.1 * rng.standard_normal(truth.shape), 0, 1).astype(np.float32)
    half = np.where(rng.uniform(size=(*SHAPE, 1)) < 0.5, noisy, soft(truth)).astype(np.float32)
    samples = [(soft(truth), noisy, where, truth), (noisy, half, where, truth)]
    samples.append((truth, truth, np.zeros(SHAPE, bool), truth))
    found = best_blend(samples)
    scores = {
        (share, tolerance): sum(score(*sample, Blend(share, tolerance)) for sample in samples[:2])
        for share in SHARES
        for tolerance in TOLERANCES
    }
    assert scores[found.share, found.tolerance] == pytest.approx(max(scores.values()), abs=1e-3)


def test_without_pixels_that_both_know_the_default_stays(truth):
    assert best_blend([]) == Blend()
    assert best_blend([(truth, truth, np.zeros(SHAPE, bool), truth)]) == Blend()


@pytest.mark.parametrize("blend", [Blend(), Blend(1.0, 4.0), Blend(0.0, 0.05), Blend(0.65, 0.1)])
def test_a_blend_lies_between_the_two_and_is_the_memorys_elsewhere(truth, where, blend):
    shown, memory = soft(truth), np.random.default_rng(3).uniform(0, 1, truth.shape)
    memory = memory.astype(np.float32)
    result = blended(shown, memory, where, blend=blend)
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result[~where], memory[~where])
    least, most = np.minimum(shown, memory), np.maximum(shown, memory)
    assert (result >= least - 1e-6).all()
    assert (result <= most + 1e-6).all()


def test_what_only_one_knows_does_not_count(truth, where):
    shown, memory = soft(truth), truth.copy()
    other = memory.copy()
    other[~where] = 0
    first = blended(shown, memory, where, blend=Blend())
    second = blended(shown, other, where, blend=Blend())
    np.testing.assert_array_equal(first[where], second[where])


def test_a_share_of_one_with_equal_blurs_is_the_memory(truth):
    everywhere = np.ones(SHAPE, bool)
    result = blended(truth, truth + np.float32(1e-4), everywhere, blend=Blend(1.0, 4.0))
    np.testing.assert_allclose(result, truth + 1e-4, atol=1e-6)
