from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gvtools.completers.geoverse.objective import gradient_weights, high_gradient_loss, rgb_loss

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.filterwarnings("error")]

SIZE = (9, 11)


def pictures(*, size: tuple[int, int] = SIZE, views: int = 2) -> torch.Tensor:
    return torch.rand(1, views, 3, *size, generator=torch.Generator().manual_seed(0))


def everywhere(images: torch.Tensor) -> torch.Tensor:
    return torch.ones(*images.shape[:2], *images.shape[-2:], dtype=torch.bool)


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-1e4, 1e4),
    st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64]),
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
def test_constant_pictures_of_any_brightness_size_and_precision_have_no_weight(value, dtype, size):
    images = torch.full((1, 2, 3, *size), value, dtype=dtype)
    assert not gradient_weights(images, everywhere(images)).any()


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2)])
def test_the_smallest_pictures_have_weights(size):
    images = pictures(size=size)
    weights = gradient_weights(images, everywhere(images))
    assert weights.shape == (1, 2, *size)
    assert weights.isfinite().all()
    assert bool(weights.any()) is (size != (1, 1))


@pytest.mark.parametrize("poison", [math.nan, math.inf, 3e38])
def test_masks_of_nothing_and_of_one_pixel_leave_no_trace_of_the_rest(poison):
    images = torch.full((1, 2, 3, *SIZE), poison)
    valid = torch.zeros(1, 2, *SIZE, dtype=torch.bool)
    assert not gradient_weights(images, valid).any()
    valid[0, 1, 4, 4] = True
    images[0, 1, :, 4, 4] = 0.5
    assert not gradient_weights(images, valid).any()


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("loss", [rgb_loss, high_gradient_loss])
def test_reference_pixels_that_are_not_finite_count_as_absent_in_the_losses(loss, poison):
    reference = pictures()
    predicted = (reference + 0.1).requires_grad_()
    damaged = reference.clone()
    damaged[0, 0, 1, 2:5, 3:6] = poison
    masked = everywhere(reference)
    masked[0, 0, 2:5, 3:6] = False
    found = loss(predicted, damaged)
    assert found.item() == pytest.approx(loss(predicted, reference, valid=masked).item())
    (gradient,) = torch.autograd.grad(found.sum(), predicted)
    assert gradient.isfinite().all() and not gradient[0, 0, :, 2:5, 3:6].any()
