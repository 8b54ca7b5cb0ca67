from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import oracle_flow_cases as cases
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import ABSENT, ORACLE
from oracle_networks import Fixture

from gvtools.completers.geoverse.flow import (
    GLD_END,
    check_bounds,
    clean_from_velocity,
    gld_time_grid,
    guided,
    integrate,
    interpolate,
    interval_bounds,
    latent_shift,
    sample,
    shift_time,
    time_grid,
    training_times,
    unshift_time,
    velocity_from_clean,
    velocity_target,
)
from gvtools.errors import OptionError

SHAPE = (2, 3, 4, 2, 3)
SHIFTS = st.floats(0.05, 100)


def _pair(seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    clean, noise = torch.randn(2, *SHAPE, generator=generator, dtype=dtype)
    return clean, noise


# --- reference values ---------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.skipif(not (ORACLE / "gld_time.json").is_file(), reason=ABSENT)
@pytest.mark.parametrize(
    "check", [cases.check_shifts, cases.check_grids, cases.check_training_shift, cases.check_path]
)
def test_times_and_path_equal_the_reference_values(check):
    check(Fixture("gld_time"))


@pytest.mark.data
@pytest.mark.skipif(not (ORACLE / "gld_sampler.json").is_file(), reason=ABSENT)
@pytest.mark.parametrize("check", [cases.check_sampler_grids, cases.check_losses])
def test_sampler_grids_and_latent_losses_equal_the_reference_values(check):
    check(Fixture("gld_sampler"))


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

    bounds = interval_bounds(steps, shift=shift)
    np.testing.assert_allclose(bounds, scheduler.sigmas.numpy(), atol=1e-6)
    ours = sample(velocity, noise, bounds)
    assert float((ours - expected).abs().max() / expected.abs().max()) <= 1e-6


# --- time ---------------------------------------------------------------------------------------


@given(st.floats(0, 1), SHIFTS, SHIFTS)
def test_shifts_multiply(t, first, second):
    twice = shift_time(shift_time(t, first), second)
    assert twice == pytest.approx(shift_time(t, first * second), abs=1e-9)


@given(st.integers(1, 60), SHIFTS)
def test_default_bounds_are_bounds_and_equally_long_before_the_shift(count, shift):
    bounds = interval_bounds(count, shift=shift)
    assert check_bounds(bounds) == bounds
    assert bounds[0] == 1 and bounds[-1] == 0
    before = [unshift_time(tau, shift) for tau in bounds]
    np.testing.assert_allclose(np.diff(before), -1 / count, atol=1e-9)


def test_thirds_of_glds_shift_are_those_published():
    # research notes, 1.5: s = 31.18 puts the thirds at 1, 0.984, 0.940, 0
    thirds = interval_bounds(3, shift=latent_shift(1536 * 18 * 18 * 8))
    np.testing.assert_allclose(thirds, (1, 0.984, 0.940, 0), atol=5e-4)


def test_glds_grid_ends_with_noise_left():
    shift = latent_shift(1536 * 18 * 18 * 8)
    grid = gld_time_grid(50, shift=shift)
    assert len(grid) == 50
    assert grid[-1] == shift_time(GLD_END, shift) == pytest.approx(0.0303, abs=1e-4)


def test_a_grid_may_cover_a_part_of_time():
    grid = time_grid(4, shift=3.0, start=0.8, end=0.2)
    assert (grid[0], grid[-1]) == (0.8, 0.2)
    before = [unshift_time(t, 3.0) for t in grid]
    np.testing.assert_allclose(np.diff(before, n=2), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ([1.0], "1 value"),
        ([0.9, 0.0], "begin at 0.9"),
        ([1, 0.5, 0.5, 0], r"tau_2 = 0.5 is not below tau_1"),
        ([1, 0.2, 0.6, 0], r"tau_2 = 0.6 is not below tau_1"),
        ([1, math.nan, 0], "tau_1 = nan"),
        ([1, 0.5, -0.1], "end at -0.1"),
    ],
)
def test_wrong_bounds_are_refused_with_the_place(bounds, said):
    with pytest.raises(OptionError, match=said):
        interval_bounds(bounds)


def test_explicit_bounds_pass_as_they_are():
    assert interval_bounds([1, 0.7, 0.1], shift=5.0) == (1.0, 0.7, 0.1)


def test_training_times_follow_the_shifted_uniform_distribution():
    generator = torch.Generator().manual_seed(3)
    uniform = torch.rand(20000, generator=generator)
    times = training_times(uniform, shift=19.6, most=0.999)
    assert times.shape == (20000,)
    assert float(times.min()) >= 0 and float(times.max()) <= shift_time(0.999, 19.6)
    uniform = unshift_time(times.double(), 19.6).sort().values / 0.999
    steps = torch.arange(1, 20001) / 20000
    assert float((uniform - steps).abs().max()) < 1.63 / math.sqrt(20000)  # Kolmogorov, 1 %


# --- path ---------------------------------------------------------------------------------------


@given(st.floats(0, 1))
def test_the_path_is_straight(t):
    clean, noise = _pair()
    state, u = interpolate(clean, noise, t), velocity_target(clean, noise)
    torch.testing.assert_close(state, clean + t * u)
    torch.testing.assert_close(clean_from_velocity(u, state, t), clean)


def test_each_sample_has_its_own_time():
    clean, noise = _pair()
    t = torch.tensor([0.25, 0.75], dtype=torch.float64)
    state = interpolate(clean, noise, t)
    for b in range(2):
        torch.testing.assert_close(state[b], interpolate(clean[b], noise[b], float(t[b])))


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


# --- sampling -----------------------------------------------------------------------------------


@settings(deadline=None)
@given(st.lists(st.floats(0.001, 0.999), max_size=5, unique=True))
def test_a_constant_velocity_recovers_the_clean_state_over_any_bounds(inner):
    clean, noise = _pair()
    bounds = [1.0, *sorted(inner, reverse=True), 0.0]
    found = sample(lambda x, t: velocity_target(clean, noise), noise, bounds)
    torch.testing.assert_close(found, clean)


def test_a_linear_equation_converges_with_order_one():
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    start = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    # dx/dt = x A from t = 1 to 0 has the solution x(0) = x(1) exp(-A)
    exact = start @ torch.linalg.matrix_exp(-matrix)
    errors = [
        float((sample(lambda x, t: x @ matrix, start, interval_bounds(n)) - exact).norm())
        for n in (64, 128, 256, 512)
    ]
    orders = [math.log2(coarse / fine) for coarse, fine in pairwise(errors)]
    assert all(0.9 < order < 1.1 for order in orders), orders


def test_each_step_is_evaluated_at_its_beginning():
    seen = []

    def velocity(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        seen.append(t.tolist())
        return torch.zeros_like(x)

    reported = []
    noise = _pair(dtype=torch.float32)[1]
    sample(velocity, noise, [1, 0.5, 0.25, 0], callback=lambda n, t, x: reported.append((n, t)))
    assert seen == [[1.0, 1.0], [0.5, 0.5], [0.25, 0.25]]
    assert [(n, t.tolist()) for n, t in reported] == [(1, [0.5] * 2), (2, [0.25] * 2), (3, [0] * 2)]


def test_samples_may_run_over_times_of_their_own():
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    state = torch.randn(2, 4, generator=generator, dtype=torch.float64)
    times = torch.tensor([[1.0, 0.6], [0.8, 0.5], [0.6, 0.1]], dtype=torch.float64)

    def velocity(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return x @ matrix + t[:, None]

    both = integrate(velocity, state, times)
    for b in range(2):
        alone = integrate(velocity, state[b : b + 1], times[:, b].tolist())
        torch.testing.assert_close(both[b : b + 1], alone)


def test_guidance_moves_away_from_the_unconditional_velocity():
    noise = _pair()[1]
    bare, given_ = torch.full_like(noise, 2.0), torch.full_like(noise, 5.0)
    calls = []

    def unconditional(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return bare

    for scale, expected in ((1.5, 6.5), (0.0, 2.0), (3.0, 11.0)):
        found = sample(
            lambda x, t: given_, noise, [1, 0], unconditional=unconditional, cfg_scale=scale
        )
        torch.testing.assert_close(noise - found, torch.full_like(noise, expected))
    calls.clear()
    sample(lambda x, t: given_, noise, [1, 0], unconditional=unconditional, cfg_scale=1.0)
    assert not calls
    with pytest.raises(OptionError, match="needs an unconditional"):
        guided(lambda x, t: x, None, 1.5)


def test_gradients_pass_through_sampling():
    noise = _pair()[1].requires_grad_()
    gain = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    sample(lambda x, t: gain * x, noise, [1, 0.5, 0]).sum().backward()
    torch.testing.assert_close(noise.grad, torch.full_like(noise, 0.75**2))
    assert gain.grad is not None and bool(gain.grad.isfinite())
