from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

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
from gvtools.errors import OptionError

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


@given(st.integers(1, 60), SHIFTS)
def test_default_bounds_are_bounds_and_equally_long_before_the_shift(count, shift):
    bounds = time_grid(count, shift=shift)
    assert check_bounds(bounds) == bounds
    assert bounds[0] == 1 and bounds[-1] == 0
    before = [unshift_time(tau, shift) for tau in bounds]
    np.testing.assert_allclose(np.diff(before), -1 / count, atol=1e-9)


def test_a_grid_may_cover_a_part_of_time():
    grid = time_grid(4, shift=3.0, start=0.8, end=0.2)
    assert (grid[0], grid[-1]) == (0.8, 0.2)
    before = [unshift_time(t, 3.0) for t in grid]
    np.testing.assert_allclose(np.diff(before, n=2), 0, atol=1e-12)


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


def test_half_precision_states_keep_their_dtype_and_a_fine_time():
    clean, noise = (x.to(torch.bfloat16) for x in _pair())
    t = torch.tensor([0.9989, 0.9989])
    state = interpolate(clean, noise, t)
    assert state.dtype == torch.bfloat16
    exact = 0.0011 * clean.double() + 0.9989 * noise.double()
    assert float((state.double() - exact).abs().max()) <= 2**-8 * float(exact.abs().max())


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


@settings(deadline=None)
@given(st.permutations(NAMES), st.integers(1, 4))
def test_a_views_noise_does_not_depend_on_its_company(order, count):
    alone = {name: _noise([name])[0, 0] for name in NAMES}
    together = _noise(list(order)[:count])
    for index, name in enumerate(order[:count]):
        assert torch.equal(together[0, index], alone[name])


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
