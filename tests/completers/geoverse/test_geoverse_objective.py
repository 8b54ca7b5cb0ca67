from __future__ import annotations

import math
from itertools import pairwise

import geoverse_loss_reference as formula
import numpy as np
import pytest
import torch
from geoverse_loss_reference import weights
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from torch import Tensor

from gvtools.completers.geoverse.flow import (
    check_bounds,
    clean_from_velocity,
    guide,
    interpolate,
    interval_ends,
    interval_times,
    reflow_pair,
    sample,
    seeded_noise,
    shift_time,
    time_grid,
    training_times,
    unshift_time,
    velocity_from_clean,
    velocity_target,
    view_seed,
)
from gvtools.completers.geoverse.objective import (
    DEFECTS,
    center_similarity,
    depth_loss,
    flow_matching_loss,
    gradient_weights,
    high_gradient_loss,
    objective,
    rgb_loss,
    sobel_magnitude,
)
from gvtools.errors import OptionError
from gvtools.similarity import fit_similarity

B, V, CONTEXT = 2, 5, 2
T = V - CONTEXT
TERMS = ["level1", "level0", "rgb", "hf", "depth"]


def _batch() -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    generator = torch.Generator().manual_seed(0)
    shapes = {
        "level1": (B, V, 4, 3, 3),
        "level0": (B, V, 4, 3, 3),
        "image": (B, T, 3, 6, 6),
        "depth": (B, T, 6, 6),
        "centers": (B, V, 3),
    }
    predicted, reference = (
        {name: torch.rand(shape, generator=generator) for name, shape in shapes.items()}
        for _ in range(2)
    )
    return {name: values.requires_grad_() for name, values in predicted.items()}, reference


def test_the_total_is_the_weighted_sum_of_the_terms():
    predicted, reference = _batch()
    weights = {"level1": 0.5, "level0": 2.0, "rgb": 3.0, "hf": 4.0, "depth": 5.0}
    found = objective(predicted, reference, context=CONTEXT, weights=weights)
    pairs = {name: (values, reference[name]) for name, values in predicted.items()}
    expected = {
        "level1": flow_matching_loss(*pairs["level1"], context=CONTEXT),
        "level0": flow_matching_loss(*pairs["level0"], context=CONTEXT),
        "rgb": rgb_loss(*pairs["image"]),
        "hf": high_gradient_loss(*pairs["image"]),
        "depth": depth_loss(*pairs["depth"], similarity=center_similarity(*pairs["centers"])),
    }
    assert list(found.terms) == TERMS
    for name, value in expected.items():
        torch.testing.assert_close(found.terms[name], value.mean())
    total = sum(weights[name] * expected[name].mean() for name in TERMS)
    torch.testing.assert_close(found.total, total)
    only = objective({"level1": predicted["level1"]}, reference, context=CONTEXT, weights={})
    assert list(only.terms) == ["level1"] and not only.counts
    torch.testing.assert_close(only.total, only.terms["level1"])


def test_a_term_of_coefficient_zero_is_logged_but_pulls_at_nothing():
    predicted, reference = _batch()
    broken = torch.full((B, T, 6, 6), torch.nan, requires_grad=True)
    weights = {"depth": 0.0, "hf": 0.0}
    found = objective({**predicted, "depth": broken}, reference, context=CONTEXT, weights=weights)
    assert bool(found.terms["depth"].isnan()) and not found.terms["depth"].requires_grad
    assert bool(found.total.isfinite()) and found.terms["hf"] > 0
    found.total.backward()
    assert broken.grad is None
    nothing = dict.fromkeys(TERMS, 0.0)
    assert float(objective(predicted, reference, context=CONTEXT, weights=nothing).total) == 0


def test_missing_targets_are_counted_and_give_zero_within_the_graph():
    predicted, reference = _batch()
    known = torch.arange(B * V).view(B, V, 1) <= V
    reference |= {
        "image_valid": torch.zeros(B, T, 6, 6, dtype=torch.bool),
        "depth": torch.zeros(B, T, 6, 6),
        "centers": torch.where(known, reference["centers"], torch.nan),
    }
    weights = {"level1": 0.0, "level0": 0.0}
    found = objective(predicted, reference, context=CONTEXT, weights=weights)
    assert found.total.item() == 0 and found.total.requires_grad
    found.total.backward()
    for name in ("image", "depth"):
        gradient = predicted[name].grad
        assert gradient is not None and not bool(gradient.any())
    assert {name: int(value) for name, value in found.counts.items()} == {
        "rgb_pixels": 0,
        "rgb_empty": B,
        "depth_pixels": 0,
        "depth_empty": B,
        "depth_without_scale": 1,
    }


H, W = 5, 6
SEEDS = st.integers(0, 2**32 - 1)


def _normal(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.tensor(rng.normal(size=shape))


def _mask(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.tensor(rng.random(shape) < rng.choice([0.0, 0.5, 1.0]))


def _outside(values: Tensor, mask: Tensor, poison: float) -> Tensor:
    return torch.where(mask, values, poison)


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


def _depths(rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Predicted depth, reference depth with gaps, predicted and reference centres."""
    predicted = torch.tensor(rng.uniform(0.5, 2, (B, T, H, W)))
    reference = torch.tensor(rng.uniform(1, 6, (B, T, H, W)))
    gaps = torch.tensor(rng.choice([np.nan, np.inf, 0.0, -1.0], (B, T, H, W)))
    reference = torch.where(torch.tensor(rng.random((B, T, H, W)) < 0.3), gaps, reference)
    return (predicted, reference, _normal(rng, B, V, 3), _normal(rng, B, V, 3))


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


@pytest.mark.parametrize("size", [(9, 7), (1, 5), (5, 1), (1, 1), (2, 2)])
def test_whole_pictures_have_scipys_sobel_gradient(size):
    gray = np.random.default_rng(0).random((2, 3, *size))
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


def _rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def _fit(predicted, reference):
    return center_similarity(
        torch.as_tensor(np.asarray(predicted))[None], torch.as_tensor(np.asarray(reference))[None]
    )


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
    singular = np.linalg.svd((predicted - predicted.mean(0)).T @ (predicted - predicted.mean(0)))[1]
    expected = 2 * (singular[0] + singular[1] - singular[2]) / singular.sum()
    assert float(fit.scale) == pytest.approx(expected, rel=1e-9)
    assert 0 < float(fit.scale) < 2


def test_centres_on_a_line_give_a_scale_where_the_numpy_fit_refuses():
    line = np.linspace(0, 1, 5)[:, None] * np.array([[1.0, 2.0, -1.0]]) + 3
    reference = 4 * line @ _rotation(np.random.default_rng(0)).T
    assert not fit_similarity(line, reference).ok
    fit = _fit(line, reference)
    assert bool(fit.ok) and float(fit.scale) == pytest.approx(4)


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
        (np.full((3, 3), 0.1), np.eye(3), 2),
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
    assert not bool(fit.ok) and bool(fit.scale.isnan())


SHAPE = (2, 3, 4, 2, 3)
SHIFTS = st.floats(0.05, 100)


def _pair(seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    clean, noise = torch.randn(2, *SHAPE, generator=generator, dtype=dtype)
    return clean, noise


@pytest.mark.parametrize("shift", [1.0, 3.0, 31.176914536239792])
@pytest.mark.parametrize("steps", [1, 3, 20])
def test_euler_steps_equal_those_of_diffusers(steps, shift):
    diffusers = pytest.importorskip("diffusers", reason="diffusers is not installed")
    matrix = 0.3 * torch.randn(24, 24, generator=torch.Generator().manual_seed(5))
    noise = _pair(1, torch.float32)[1]

    def velocity(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        turned = (x.reshape(2, -1, 24) @ matrix).reshape(x.shape)
        return turned + torch.sin(3 * t).reshape(-1, 1, 1, 1, 1)

    # Theirs shifts the sigmas itself and ends at 0; ours receives the shifted bounds.
    scheduler = diffusers.FlowMatchEulerDiscreteScheduler(shift=shift)
    scheduler.set_timesteps(sigmas=[1 - k / steps for k in range(steps)])
    expected = noise
    for sigma, time in zip(scheduler.sigmas, scheduler.timesteps, strict=False):
        expected = scheduler.step(velocity(expected, sigma.expand(2)), time, expected).prev_sample

    bounds = time_grid(steps, shift=shift)
    np.testing.assert_allclose(bounds, scheduler.sigmas.numpy(), atol=1e-6)
    ours = sample(velocity, noise, bounds)
    assert float((ours - expected).abs().max() / expected.abs().max()) <= 1e-6


@given(st.integers(1, 60), SHIFTS, st.sampled_from([0.0, 0.001]))
def test_time_grids_are_bounds_and_equally_long_before_the_shift(count, shift, end):
    bounds = time_grid(count, shift=shift, end=end)
    assert check_bounds(bounds) == bounds
    assert bounds[0] == 1 and bounds[-1] == end
    before = [unshift_time(tau, shift) for tau in bounds]
    np.testing.assert_allclose(np.diff(before), (before[-1] - 1) / count, atol=1e-9)


def test_training_times_follow_the_shifted_uniform_distribution():
    generator = torch.Generator().manual_seed(3)
    uniform = torch.rand(20000, generator=generator)
    times = training_times(uniform, shift=19.6, most=0.999)
    assert times.shape == (20000,)
    assert float(times.min()) >= 0 and float(times.max()) <= shift_time(0.999, 19.6)
    uniform = unshift_time(times.double(), 19.6).sort().values / 0.999
    steps = torch.arange(1, 20001) / 20000
    assert float((uniform - steps).abs().max()) < 1.63 / math.sqrt(20000)  # Kolmogorov, 1 %


@given(st.floats(0, 1))
def test_the_path_is_straight(t):
    clean, noise = _pair()
    state, u = interpolate(clean, noise, t), velocity_target(clean, noise)
    torch.testing.assert_close(state, clean + t * u)
    torch.testing.assert_close(clean_from_velocity(u, state, t), clean)


def test_a_prediction_of_the_clean_state_gives_the_velocity():
    clean, noise = _pair()
    for t in (1.0, 0.5, 0.06):
        state = interpolate(clean, noise, t)
        torch.testing.assert_close(velocity_from_clean(clean, state, t), noise - clean)
    times = torch.tensor([0.5, 0.01], dtype=torch.float64)
    state = interpolate(clean, noise, times)
    found = velocity_from_clean(clean, state, times, least=0.05)
    torch.testing.assert_close(found[0], (noise - clean)[0])
    torch.testing.assert_close(found[1], (noise - clean)[1] * 0.01 / 0.05)
    torch.testing.assert_close(velocity_from_clean(clean[1], state[1], 0.01), found[1])


def test_guidance_moves_away_from_the_unconditional_velocity():
    noise = _pair()[1]
    bare, given_ = torch.full_like(noise, 2.0), torch.full_like(noise, 5.0)

    def both(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        assert torch.equal(x, torch.cat((noise, noise))) and len(t) == len(x)
        return torch.cat((bare, given_))

    for scale, expected in ((1.5, 6.5), (0.0, 2.0), (3.0, 11.0)):
        found = sample(guide(both, scale), noise, [1, 0])
        torch.testing.assert_close(noise - found, torch.full_like(noise, expected))


NAMES = ["a", "b", "c", "d"]
GRID = (5, 4, 6)


def _noise(names: list[str], **options) -> torch.Tensor:
    return seeded_noise((1, len(names), *GRID), [[view_seed(7, n) for n in names]], **options)


def test_noise_is_white_and_differs_between_views_seeds_and_draws():
    seeds = [view_seed(s, draw, n) for s in (0, 1) for draw in ("level1", "level0") for n in NAMES]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2**63 for seed in seeds)
    noise = seeded_noise((4, 4, 8, 20, 20), [seeds[k : k + 4] for k in range(0, 16, 4)]).flatten(2)
    rows = noise.reshape(16, -1)
    assert float(rows.mean(1).abs().max()) < 5 / 3200**0.5
    assert float((rows.std(1) - 1).abs().max()) < 5 / 6400**0.5
    correlation = torch.corrcoef(rows) - torch.eye(16)
    assert float(correlation.abs().max()) < 5 / 3200**0.5


def test_seeds_are_the_same_in_every_session():
    # echo -n '[0, "level1", "frame_7"]' | b2sum -l 64, without its lowest bit
    assert view_seed(0, "level1", "frame_7") == 6824952135169501610


BOUNDS = (1.0, 0.75, 0.25, 0.0)
LATENTS = (3, 2, 4, 2, 2)


def _latents(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    clean, noise = torch.randn(2, *LATENTS, generator=generator, dtype=torch.float64)
    return clean, noise


def test_intervals_are_drawn_equally_often_and_times_uniformly():
    which, inside = torch.rand(2, 30000, generator=torch.Generator().manual_seed(0))
    intervals, t = interval_times(which, inside, BOUNDS)
    share = torch.bincount(intervals, minlength=3) / 30000
    assert float((share - 1 / 3).abs().max()) < 5 * math.sqrt(2 / 9 / 30000)
    upper, lower = interval_ends(intervals, BOUNDS)
    eta = ((t.double() - lower) / (upper - lower)).sort().values
    assert float((eta - torch.arange(1, 30001) / 30000).abs().max()) < 1.63 / math.sqrt(30000)


@pytest.mark.parametrize("steps", [1, 4])
def test_a_teacher_of_straight_paths_gives_the_flow_matching_target(steps):
    # A teacher that knows the one clean state moves along straight lines: X- lies on the path, and
    # the reflow velocity is noise - clean at x_t itself.
    clean, noise = _latents()
    intervals, t = torch.tensor([0, 1, 2]), torch.tensor([0.8, 0.6, 0.125])
    pair = reflow_pair(
        lambda x, t: velocity_from_clean(clean, x, t, least=1e-9),
        clean,
        noise,
        intervals=intervals,
        t=t,
        bounds=BOUNDS,
        steps=steps,
        shift=3.0,
    )
    torch.testing.assert_close(pair.velocity, noise - clean)
    torch.testing.assert_close(pair.state, interpolate(clean, noise, t.double()), atol=1e-6, rtol=0)
    assert torch.equal(pair.t, t.double())


def test_the_pair_is_that_of_the_formulas_for_a_curved_teacher():
    clean, noise = _latents(1)
    matrix = torch.randn(4, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def teacher(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return torch.einsum("bvchw,cd->bvdhw", x, matrix) * (1 + t.reshape(-1, 1, 1, 1, 1))

    intervals, t = torch.tensor([2, 0, 1]), torch.tensor([0.1, 0.8, 0.5], dtype=torch.float64)
    pair = reflow_pair(
        teacher, clean, noise, intervals=intervals, t=t, bounds=BOUNDS, steps=6, shift=2.0
    )
    assert not pair.velocity.requires_grad
    for b, a in enumerate(intervals.tolist()):
        upper, lower = BOUNDS[a], BOUNDS[a + 1]
        start = (1 - upper) * clean[b] + upper * noise[b]
        u = np.linspace(upper / (2 - upper), lower / (2 - lower), 7)  # before the shift of 2
        x = start
        for now, after in pairwise(u):
            now, after = 2 * now / (1 + now), 2 * after / (1 + after)
            x = x + (after - now) * teacher(x[None], torch.tensor([now]))[0]
        eta = (float(t[b]) - lower) / (upper - lower)
        torch.testing.assert_close(pair.velocity[b], (start - x) / (upper - lower))
        torch.testing.assert_close(pair.state[b], eta * start + (1 - eta) * x)


@pytest.mark.parametrize(
    "bounds",
    [[1.0], [0.9, 0.0], [1, 0.5, 0.5, 0], [1, 0.2, 0.6, 0], [1, math.nan, 0], [1, 0.5, -0.1]],
)
def test_wrong_bounds_are_refused(bounds):
    with pytest.raises(OptionError, match=r"interval bounds .*expected 1 = tau_0"):
        sample(lambda x, t: x, torch.zeros(1, 2), bounds)
