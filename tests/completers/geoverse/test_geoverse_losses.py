from __future__ import annotations

import geoverse_loss_reference as formula
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gvtools.completers.geoverse.objective import (
    center_similarity,
    depth_loss,
    flow_matching_loss,
    high_gradient_loss,
    rgb_loss,
    view_errors,
)

B, V, CONTEXT, H, W = 2, 5, 2, 5, 6
T = V - CONTEXT
SEEDS = st.integers(0, 2**32 - 1)


def _normal(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.tensor(rng.normal(size=shape))


def _mask(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.tensor(rng.random(shape) < rng.choice([0.0, 0.5, 1.0]))


def _outside(values: Tensor, mask: Tensor, poison: float) -> Tensor:
    return torch.where(mask, values, poison)


# --- flow matching ------------------------------------------------------------------------------


@settings(deadline=None)
@given(SEEDS, st.integers(0, V), st.floats(0, 2))
def test_the_flow_loss_is_a_constant_factor_of_the_papers_formula(seed, context, alpha):
    rng = np.random.default_rng(seed)
    predicted, clean, noise = (_normal(rng, B, V, 3, 2, 2) for _ in range(3))
    options = {"context": context, "context_weight": alpha}
    found = flow_matching_loss(predicted, noise - clean, **options)
    for b in range(B):
        weights = [alpha] * context + [1.0] * (V - context)
        expected = formula.flow_matching(
            predicted[b].numpy(), clean[b].numpy(), noise[b].numpy(), weights
        )
        assert float(found[b]) * (3 * 2 * 2 * V) == pytest.approx(expected)


def test_context_views_weigh_a_quarter():
    predicted = torch.zeros(1, 2, 1, 1, 1)
    target = torch.tensor([3.0, 5.0]).reshape(1, 2, 1, 1, 1)
    found = flow_matching_loss(predicted, target, context=1)
    assert float(found) == (0.25 * 9 + 25) / 2


# --- pictures -----------------------------------------------------------------------------------


@settings(deadline=None, max_examples=50)
@given(SEEDS)
def test_picture_losses_are_the_papers_formulas(seed):
    rng = np.random.default_rng(seed)
    predicted, image = _normal(rng, B, T, 3, H, W), _normal(rng, B, T, 3, H, W)
    valid = _mask(rng, B, T, H, W)
    rgb = rgb_loss(predicted, image, valid=valid)
    hf = high_gradient_loss(predicted, image, valid=valid)
    for b in range(B):
        sample = predicted[b].numpy(), image[b].numpy(), valid[b].numpy()
        assert float(rgb[b]) == pytest.approx(formula.rgb(*sample), rel=1e-9)
        assert float(hf[b]) == pytest.approx(formula.high_gradient(*sample), rel=1e-9)


@pytest.mark.parametrize("loss", [rgb_loss, high_gradient_loss])
@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_what_lies_outside_the_mask_poisons_neither_picture_loss_nor_gradient(loss, poison):
    rng = np.random.default_rng(3)
    predicted, image = _normal(rng, B, T, 3, H, W), _normal(rng, B, T, 3, H, W)
    valid = torch.tensor(rng.random((B, T, H, W)) < 0.6)
    shown = valid[:, :, None].expand_as(image)
    expected = loss(predicted, image, valid=valid)
    damaged = _outside(predicted, shown, poison).requires_grad_()
    found = loss(damaged, _outside(image, shown, poison), valid=valid)
    torch.testing.assert_close(found, expected)
    found.sum().backward()
    assert damaged.grad is not None and bool(damaged.grad.isfinite().all())
    assert not bool(damaged.grad[~shown].any()) and bool(damaged.grad[shown].any())


def test_a_diverged_prediction_is_not_hidden():
    image = torch.rand(1, 1, 3, 4, 4)
    predicted = image.clone()
    predicted[0, 0, 0, 0, 0] = np.nan
    assert bool(rgb_loss(predicted, image).isnan().all())


@pytest.mark.parametrize("loss", [rgb_loss, high_gradient_loss])
def test_samples_without_pixels_give_zero_within_the_graph(loss):
    predicted = torch.rand(B, T, 3, H, W, requires_grad=True)
    valid = torch.zeros(B, T, H, W, dtype=torch.bool)
    found = loss(predicted, torch.full((B, T, 3, H, W), np.nan), valid=valid)
    assert found.tolist() == [0.0] * B and found.requires_grad
    found.sum().backward()
    assert predicted.grad is not None and not bool(predicted.grad.any())


def test_constant_pictures_and_single_pixels_have_no_high_gradient():
    predicted = torch.rand(1, 2, 3, 8, 8, requires_grad=True)
    image = torch.full((1, 2, 3, 8, 8), 0.3)
    for valid in (None, torch.rand(1, 2, 8, 8) < 0.5):
        found = high_gradient_loss(predicted, image, valid=valid)
        assert found.tolist() == [0.0] and found.requires_grad
    assert rgb_loss(predicted, image).item() > 0
    one = torch.zeros(1, 2, 8, 8, dtype=torch.bool)
    one[0, 1, 3, 3] = True
    textured = torch.rand(1, 2, 3, 8, 8)
    assert high_gradient_loss(predicted, textured, valid=one).tolist() == [0.0]
    expected = (predicted - textured)[0, 1, :, 3, 3].abs().mean()
    torch.testing.assert_close(rgb_loss(predicted, textured, valid=one)[0], expected)


def test_a_picture_of_almost_no_contrast_is_weighted_by_the_formula():
    # weights far below 1: delta holds the share down, and their sum, below 1, still divides
    rng = np.random.default_rng(0)
    predicted, image = _normal(rng, 1, T, 3, H, W), 0.5 + 1e-9 * _normal(rng, 1, T, 3, H, W)
    valid = np.ones((T, H, W), bool)
    assert 0 < formula.weights(image[0].numpy(), valid).sum() < 1
    expected = formula.high_gradient(predicted[0].numpy(), image[0].numpy(), valid)
    assert high_gradient_loss(predicted, image).item() == pytest.approx(expected, rel=1e-6)


def test_the_weights_follow_the_reference_and_not_the_prediction():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 1, 3, 12, 12, generator=generator)
    predicted = image + 0.1  # the same error everywhere: any weights give 0.1
    torch.testing.assert_close(high_gradient_loss(predicted, image), torch.tensor([0.1]))
    flat = torch.full_like(image, 0.5)
    weight = formula.weights(image[0].double().numpy(), np.ones((1, 12, 12), bool))
    error = (flat - image).abs().mean(2)[0].numpy()
    expected = (weight * error).sum() / weight.sum()
    assert float(high_gradient_loss(flat, image)) == pytest.approx(expected, rel=1e-5)


def test_half_precision_pictures_are_compared_in_float32():
    image = torch.rand(1, 1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    half = image.to(torch.bfloat16)
    found = rgb_loss(half + 0.125, half)
    assert found.dtype == torch.float32
    exact = ((half + 0.125).double() - half.double()).abs().mean()
    assert float(found) == pytest.approx(float(exact), rel=1e-6)


# --- depth --------------------------------------------------------------------------------------


def _depths(rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Predicted depth, reference depth with gaps, predicted and reference centres."""
    predicted = torch.tensor(rng.uniform(0.5, 2, (B, T, H, W)))
    reference = torch.tensor(rng.uniform(1, 6, (B, T, H, W)))
    gaps = torch.tensor(rng.choice([np.nan, np.inf, 0.0, -1.0], (B, T, H, W)))
    reference = torch.where(torch.tensor(rng.random((B, T, H, W)) < 0.3), gaps, reference)
    return predicted, reference, _normal(rng, B, V, 3), _normal(rng, B, V, 3)


@settings(deadline=None, max_examples=50)
@given(SEEDS)
def test_the_depth_loss_is_the_papers_formula(seed):
    rng = np.random.default_rng(seed)
    predicted, reference, found_centers, centers = _depths(rng)
    valid = _mask(rng, B, T, H, W)
    similarity = center_similarity(found_centers, centers)
    found = depth_loss(predicted, reference, similarity=similarity, valid=valid)
    for b in range(B):
        scale = formula.scale_of(found_centers[b].numpy(), centers[b].numpy())
        expected = formula.depth(
            predicted[b].numpy(), reference[b].numpy(), scale, valid[b].numpy()
        )
        assert float(found[b]) == pytest.approx(expected, rel=1e-9)


def test_a_scene_of_another_unit_and_frame_has_no_depth_loss():
    rng = np.random.default_rng(0)
    predicted, _, centers, _ = _depths(rng)
    turn = torch.linalg.qr(_normal(rng, B, 3, 3))[0]
    turn = turn * torch.linalg.det(turn)[:, None, None]
    units = torch.tensor([0.2, 7.0], dtype=torch.float64)
    moved = units[:, None, None] * centers @ turn.mT + 5
    similarity = center_similarity(centers, moved)
    found = depth_loss(predicted, units[:, None, None, None] * predicted, similarity=similarity)
    torch.testing.assert_close(found, torch.zeros(B, dtype=torch.float64), atol=1e-9, rtol=0)


def test_samples_without_a_scale_are_dropped():
    predicted, reference, found_centers, centers = _depths(np.random.default_rng(1))
    found_centers[1] = 0.5
    similarity = center_similarity(found_centers, centers)
    assert similarity.status == ("aligned", "coincident predicted centres")
    predicted.requires_grad_()
    dropped = depth_loss(predicted, reference, similarity=similarity)
    assert dropped[1].item() == 0 < dropped[0].item()
    (gradient,) = torch.autograd.grad(dropped.sum(), predicted)
    assert not bool(gradient[1].any()) and bool(gradient[0].any())
    assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_what_lies_outside_the_mask_poisons_neither_depth_loss_nor_gradient(poison):
    predicted, reference, found_centers, centers = _depths(np.random.default_rng(2))
    known = reference.isfinite() & (reference > 0)
    damaged = _outside(predicted, known, poison).requires_grad_()
    similarity = center_similarity(found_centers, centers)
    found = depth_loss(damaged, reference, similarity=similarity)
    torch.testing.assert_close(found, depth_loss(predicted, reference, similarity=similarity))
    found.sum().backward()
    assert damaged.grad is not None and bool(damaged.grad.isfinite().all())
    assert not bool(damaged.grad[~known].any()) and bool(damaged.grad[known].all())


def test_a_batch_without_any_depth_gives_zero_within_the_graph():
    predicted = torch.rand(B, T, H, W, requires_grad=True)
    similarity = center_similarity(torch.randn(B, V, 3), torch.randn(B, V, 3))
    found = depth_loss(predicted, torch.zeros(B, T, H, W), similarity=similarity)
    assert found.tolist() == [0.0] * B
    found.sum().backward()
    assert predicted.grad is not None and not bool(predicted.grad.any())


# --- gradients ----------------------------------------------------------------------------------


def test_gradients_are_those_of_finite_differences():
    rng = np.random.default_rng(4)
    predicted, target = _normal(rng, 2, 3, 2, 2, 2).requires_grad_(), _normal(rng, 2, 3, 2, 2, 2)
    assert torch.autograd.gradcheck(lambda x: flow_matching_loss(x, target, context=1), predicted)
    image, reference = _normal(rng, 2, 2, 3, 3, 4).requires_grad_(), _normal(rng, 2, 2, 3, 3, 4)
    valid = torch.tensor(rng.random((2, 2, 3, 4)) < 0.7)
    for loss in (rgb_loss, high_gradient_loss):
        assert torch.autograd.gradcheck(lambda x, f=loss: f(x, reference, valid=valid), image)
    depth, wanted, *centers = _depths(rng)
    similarity = center_similarity(*centers)
    assert torch.autograd.gradcheck(
        lambda x: depth_loss(x, wanted, similarity=similarity), depth.requires_grad_()
    )


def test_references_receive_no_gradient():
    predicted, target = (torch.randn(1, 3, 3, 4, 4, requires_grad=True) for _ in range(2))
    depth, wanted = (torch.rand(1, 3, 4, 4, requires_grad=True) for _ in range(2))
    found, centers = (torch.randn(1, 4, 3, requires_grad=True) for _ in range(2))
    total = (
        flow_matching_loss(predicted, target, context=1)
        + rgb_loss(predicted, target)
        + high_gradient_loss(predicted, target)
        + depth_loss(depth, wanted, similarity=center_similarity(found, centers))
    )
    total.sum().backward()
    assert all(x.grad is not None for x in (predicted, depth))
    assert all(x.grad is None for x in (target, wanted, found, centers))


def test_view_errors_tell_the_views_apart():
    predicted = torch.zeros(1, 2, 1, 2, 2)
    target = torch.tensor([1.0, 2.0]).reshape(1, 2, 1, 1, 1).expand(1, 2, 1, 2, 2)
    assert view_errors(predicted, target).tolist() == [[1.0, 4.0]]
