from __future__ import annotations

import numpy as np
import pytest
import torch
from geoverse_loss_reference import sobel, weights
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from gvtools.completers.geoverse.objective import (
    gradient_weights,
    grayscale,
    sobel_magnitude,
)


def _pictures(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(seed).random(shape)


@pytest.mark.parametrize("size", [(9, 7), (1, 5), (5, 1), (1, 1), (2, 2)])
def test_whole_pictures_have_scipys_sobel_gradient(size):
    gray = _pictures(0, (2, 3, *size))
    expected = np.zeros_like(gray)
    # scipy's filter differentiates along one axis and smooths along all others: one picture a call
    for index in np.ndindex(2, 3):
        one = gray[index]
        expected[index] = np.hypot(
            ndimage.sobel(one, axis=1, mode="nearest"), ndimage.sobel(one, axis=0, mode="nearest")
        )
    found = sobel_magnitude(torch.tensor(gray), torch.ones(gray.shape, dtype=torch.bool))
    np.testing.assert_allclose(found, expected, atol=1e-12)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_masked_pictures_have_the_gradient_of_the_formula(seed, share):
    rng = np.random.default_rng(seed)
    gray, valid = rng.random((1, 2, 6, 5)), rng.random((1, 2, 6, 5)) < share
    found = sobel_magnitude(torch.tensor(np.where(valid, gray, np.nan)), torch.tensor(valid))
    for v in range(2):
        np.testing.assert_allclose(found[0, v], sobel(gray[0, v], valid[0, v]), atol=1e-12)


def test_the_edge_of_a_mask_is_no_edge_of_the_picture():
    rng = np.random.default_rng(0)
    valid = torch.tensor(rng.random((1, 1, 20, 20)) < 0.5)
    flat = torch.full((1, 1, 20, 20), 0.7)
    assert not bool(sobel_magnitude(flat, valid).any())


def test_grayscale_is_luma():
    image = torch.zeros(3, 3, 1, 1)
    image[range(3), range(3)] = 1
    torch.testing.assert_close(grayscale(image).flatten(), torch.tensor([0.299, 0.587, 0.114]))
    assert grayscale(image.to(torch.bfloat16)).dtype == torch.float32


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(1, 1, 6, 7), (2, 3, 4, 4), (2, 1, 1, 1)]))
def test_weights_are_those_of_the_formula_sample_by_sample(seed, shape):
    rng = np.random.default_rng(seed)
    batch, views, height, width = shape
    image = rng.random((batch, views, 3, height, width))
    valid = rng.random(shape) < rng.choice([0.0, 0.3, 1.0])
    image = np.where(valid[:, :, None], image, np.nan)
    found = gradient_weights(torch.tensor(image), torch.tensor(valid))
    for b in range(batch):
        np.testing.assert_allclose(found[b], weights(image[b], valid[b]), atol=1e-9)
    assert float(found.min()) >= 0 and float(found.max()) <= 1


def test_one_strong_edge_takes_the_weight_and_flat_ground_none():
    image = torch.full((1, 1, 3, 50, 50), 0.2)
    image[..., 25:] = 0.9
    found = gradient_weights(image, torch.ones(1, 1, 50, 50, dtype=torch.bool))[0, 0]
    assert bool((found[:, 24:26] > 0.99999).all())
    assert not bool(found[:, :24].any()) and not bool(found[:, 26:].any())


def test_weights_do_not_depend_on_the_pictures_brightness_or_contrast():
    image = torch.tensor(_pictures(0, (1, 2, 3, 16, 16)))
    valid = torch.ones(1, 2, 16, 16, dtype=torch.bool)
    torch.testing.assert_close(
        gradient_weights(image, valid),
        gradient_weights(0.5 * image + 0.3, valid),
        atol=1e-5,
        rtol=0,
    )


def test_no_gradient_passes():
    image = torch.rand(1, 1, 3, 8, 8, requires_grad=True)
    assert not gradient_weights(image, torch.ones(1, 1, 8, 8, dtype=torch.bool)).requires_grad
