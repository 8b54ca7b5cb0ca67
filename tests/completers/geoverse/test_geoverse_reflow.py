from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gvtools.completers.geoverse.flow import (
    fast_loss,
    integrate,
    interpolate,
    interval_ends,
    interval_times,
    reflow_pair,
    sample,
    teacher_times,
    unshift_time,
    velocity_from_clean,
)
from gvtools.completers.geoverse.objective import flow_matching_loss
from gvtools.errors import OptionError

BOUNDS = (1.0, 0.75, 0.25, 0.0)
SHAPE = (3, 2, 4, 2, 2)


def _pair(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    clean, noise = torch.randn(2, *SHAPE, generator=generator, dtype=torch.float64)
    return clean, noise


@settings(deadline=None)
@given(
    st.lists(st.floats(0.01, 0.99), min_size=1, max_size=5, unique_by=lambda x: round(x, 4)),
    st.integers(0, 2**32),
)
def test_drawn_times_lie_in_their_intervals(inner, seed):
    bounds = (1.0, *sorted(inner, reverse=True), 0.0)
    generator = torch.Generator().manual_seed(seed)
    which, share = torch.rand(2, 64, generator=generator)
    intervals, t = interval_times(which, share, bounds)
    upper, lower = interval_ends(intervals, bounds)
    assert bool(((t <= upper.float()) & (t >= lower.float())).all())
    eta = (t.double() - lower) / (upper - lower)
    assert bool(((eta >= -1e-4) & (eta <= 1 + 1e-4)).all())


def test_intervals_are_drawn_equally_often_and_times_uniformly():
    which, inside = torch.rand(2, 30000, generator=torch.Generator().manual_seed(0))
    intervals, t = interval_times(which, inside, BOUNDS)
    share = torch.bincount(intervals, minlength=3) / 30000
    assert float((share - 1 / 3).abs().max()) < 5 * math.sqrt(2 / 9 / 30000)
    upper, lower = interval_ends(intervals, BOUNDS)
    eta = ((t.double() - lower) / (upper - lower)).sort().values
    assert float((eta - torch.arange(1, 30001) / 30000).abs().max()) < 1.63 / math.sqrt(30000)


def test_the_teachers_times_run_from_end_to_end_and_are_even_before_the_shift():
    upper, lower = interval_ends(torch.tensor([0, 2, 1]), BOUNDS)
    times = teacher_times(upper, lower, steps=5, shift=7.0)
    assert torch.equal(times[0], upper) and torch.equal(times[-1], lower)
    before = unshift_time(times, 7.0)
    np.testing.assert_allclose(np.diff(before.numpy(), n=2, axis=0), 0, atol=1e-12)


@pytest.mark.parametrize("steps", [1, 4])
def test_a_teacher_of_straight_paths_gives_the_flow_matching_target(steps):
    # A teacher that knows the one clean state moves along straight lines: X- lies on the path, and
    # the reflow velocity is noise - clean at x_t itself.
    clean, noise = _pair()
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
    clean, noise = _pair(1)
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


def test_a_student_that_learnt_it_needs_one_step_an_interval():
    # The linear teacher's displacement over an interval is linear in its start: a student can know
    # it. Chained over the intervals it ends where the teacher's many steps end.
    noise = _pair(3)[1]

    def teacher(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return 0.8 * x + t.reshape(-1, 1, 1, 1, 1)

    def student(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        upper, lower = interval_ends(torch.tensor([BOUNDS.index(float(v)) for v in t]), BOUNDS)
        times = teacher_times(upper, lower, steps=50)
        return (x - integrate(teacher, x, times)) / (upper - lower)[:, None, None, None, None]

    many = noise
    for a in range(3):
        upper, lower = torch.full((2, 3), BOUNDS[a]), torch.full((2, 3), BOUNDS[a + 1])
        many = integrate(teacher, many, teacher_times(upper[0], lower[0], steps=50))
    torch.testing.assert_close(sample(student, noise, BOUNDS), many, atol=1e-6, rtol=1e-6)


def test_the_two_objectives_are_blended():
    clean, noise = _pair()
    reflow = flow_matching_loss(clean, noise, context=1)
    flow = flow_matching_loss(noise, 2 * clean, context=1)
    torch.testing.assert_close(fast_loss(reflow, flow, rho=0.3), 0.3 * reflow + 0.7 * flow)
    with pytest.raises(OptionError, match="rho"):
        fast_loss(reflow, flow, rho=1.5)
