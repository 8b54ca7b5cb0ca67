"""Piecewise reflow: a student learns the teacher's displacement over each interval as one step.

The bounds 1 = tau_0 > ... > tau_K = 0 cut time into intervals a = 0 .. K-1 of upper end tau_a and
lower end tau_{a+1}. Section "Few-Step Inference via Reflow Distillation" of the paper, after
PeRFlow (Yan et al. 2024). The loss is ``losses.flow_matching_loss`` with this module's velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gvtools.completers.geoverse.flow import (
    Velocity,
    check_bounds,
    integrate,
    interpolate,
    over_state,
    shift_time,
    unshift_time,
)
from gvtools.networks.config_json import check_range


@dataclass(frozen=True, eq=False)
class ReflowPair:
    """One batch of what a student learns from.

    Attributes:
        state: (B, ...) X~_t = eta X+ + (1 - eta) X-, between the noisy end X+ of the interval and
            its cleaner end X-, eta = (t - tau_{a+1}) / (tau_a - tau_{a+1}).
        t: (B,) float32, its time.
        velocity: (B, ...) u^T_a = (X+ - X-) / (tau_a - tau_{a+1}), that line's velocity.
    """

    state: Tensor
    t: Tensor
    velocity: Tensor


def interval_ends(intervals: Tensor, bounds: Sequence[float]) -> tuple[Tensor, Tensor]:
    """tau_a and tau_{a+1} of each interval (B,) int64: two (B,) float64 on the CPU."""
    tau = torch.tensor(check_bounds(bounds), dtype=torch.float64)
    index = intervals.cpu()
    return tau[index], tau[index + 1]


def interval_times(which: Tensor, share: Tensor, bounds: Sequence[float]) -> tuple[Tensor, Tensor]:
    """An interval (B,) int64, each as likely, and t ~ U(tau_{a+1}, tau_a) (B,) float32; on the CPU.

    Args:
        which: (B,) uniform draws in [0, 1) of the interval.
        share: (B,) uniform draws in [0, 1) of the place in it.
        bounds: tau_0 .. tau_K.
    """
    count = len(check_bounds(bounds)) - 1
    intervals = (which * count).long().clamp(max=count - 1)
    upper, lower = interval_ends(intervals, bounds)
    return intervals, (lower + share * (upper - lower)).float()


def teacher_times(upper: Tensor, lower: Tensor, *, steps: int, shift: float = 1.0) -> Tensor:
    """(steps + 1, B) times from ``upper`` to ``lower`` (B,), equally spaced before the shift."""
    check_range("teacher steps", steps, ge=1)
    share = torch.linspace(0, 1, steps + 1, dtype=upper.dtype, device=upper.device)[:, None]
    times = shift_time(
        torch.lerp(unshift_time(upper, shift), unshift_time(lower, shift), share), shift
    )
    times[0], times[-1] = upper, lower
    return times


def reflow_pair(
    teacher: Velocity,
    clean: Tensor,
    noise: Tensor,
    *,
    intervals: Tensor,
    t: Tensor,
    bounds: Sequence[float],
    steps: int,
    shift: float = 1.0,
) -> ReflowPair:
    """Run the frozen teacher through one interval a sample and draw the straight line.

    Args:
        teacher: the many-step velocity of (B, ...) and t (B,); with guidance, see ``flow.guided``.
        clean: (B, ...) reference latents F^1.
        noise: (B, ...).
        intervals: (B,) int64, a.
        t: (B,) in each interval, see ``interval_times``.
        bounds: tau_0 .. tau_K.
        steps: of the teacher in each interval.
        shift: of the teacher's time, see ``flow.shift_time``.
    """
    upper, lower = interval_ends(intervals, bounds)
    # The share is 1 at the noisy end; a time is rounded to float32, and may lie just outside.
    eta = ((t.to("cpu", torch.float64) - lower) / (upper - lower)).clamp(0, 1)
    times = teacher_times(upper, lower, steps=steps, shift=shift)
    wide = torch.promote_types(clean.dtype, torch.float32)
    upper, lower, eta = (x.to(wide).to(clean.device) for x in (upper, lower, eta))
    with torch.no_grad():
        start = interpolate(clean, noise, upper)  # X+
        end = integrate(teacher, start, times)  # X-
        velocity = ((start - end) / over_state(upper - lower, start)).to(start.dtype)
        state = interpolate(end, start, eta)
    return ReflowPair(state, t.to(wide).to(clean.device), velocity)


def fast_loss(reflow: Tensor, flow: Tensor, *, rho: float) -> Tensor:
    """L_fast = rho L_PRF + (1 - rho) L_FM, of any one shape."""
    check_range("rho", rho, ge=0, le=1)
    return rho * reflow + (1 - rho) * flow
