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
from gvtools.errors import OptionError
from gvtools.networks.config_json import check_range

# Over a shorter interval, the displacement of float32 states is mostly rounding.
SHORTEST = 1e-4


@dataclass(frozen=True, eq=False)
class ReflowPair:
    """One batch of what a student learns from.

    Attributes:
        state: (B, ...) X~_t, on the straight line between the ends of the interval.
        t: (B,) float32, its time.
        velocity: (B, ...) u^T_a, that line's velocity.
    """

    state: Tensor
    t: Tensor
    velocity: Tensor


def interval_ends(intervals: Tensor, bounds: Sequence[float]) -> tuple[Tensor, Tensor]:
    """tau_a and tau_{a+1} of each interval (B,) int64: two (B,) float64 on the CPU."""
    tau = torch.tensor(check_bounds(bounds), dtype=torch.float64)
    index = intervals.cpu()
    if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < len(tau) - 1:
        raise OptionError(f"intervals {index.tolist()}; expected 0 to {len(tau) - 2}")
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


def interval_share(t: Tensor, *, upper: Tensor, lower: Tensor) -> Tensor:
    """The share eta = (t - tau_{a+1}) / (tau_a - tau_{a+1}) (B,): 1 at the noisy end."""
    return (t - lower) / (upper - lower)


def straight_state(start: Tensor, end: Tensor, eta: float | Tensor) -> Tensor:
    """X~_t = eta X+ + (1 - eta) X- (B, ...), of the noisy end ``start`` and the cleaner ``end``."""
    return interpolate(end, start, eta)


def straight_velocity(
    start: Tensor, end: Tensor, *, upper: float | Tensor, lower: float | Tensor
) -> Tensor:
    """u^T_a = (X+ - X-) / (tau_a - tau_{a+1}) (B, ...); the ends of the interval are (B,)."""
    return ((start - end) / over_state(upper - lower, start)).to(start.dtype)


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

    Raises:
        OptionError: a time outside its interval, or an interval shorter than ``SHORTEST``.
    """
    upper, lower = interval_ends(intervals, bounds)
    if bool((upper - lower < SHORTEST).any()):
        raise OptionError(
            f"reflow over intervals of length {(upper - lower).tolist()}; expected at least "
            f"{SHORTEST:g} each"
        )
    eta = interval_share(t.to("cpu", torch.float64), upper=upper, lower=lower)
    # A time is rounded to float32, which is much of a short interval.
    rounding = 1e-6 + torch.finfo(torch.float32).eps / (upper - lower)
    if not bool(((eta >= -rounding) & (eta <= 1 + rounding)).all()):
        raise OptionError(f"times {t.tolist()} outside their intervals {intervals.tolist()}")
    eta = eta.clamp(0, 1)
    times = teacher_times(upper, lower, steps=steps, shift=shift)
    wide = torch.promote_types(clean.dtype, torch.float32)
    upper, lower, eta = (x.to(wide).to(clean.device) for x in (upper, lower, eta))
    with torch.no_grad():
        start = interpolate(clean, noise, upper)  # X+
        end = integrate(teacher, start, times)  # X-
        velocity = straight_velocity(start, end, upper=upper, lower=lower)
        return ReflowPair(straight_state(start, end, eta), t.to(wide).to(clean.device), velocity)


def fast_loss(reflow: Tensor, flow: Tensor, *, rho: float) -> Tensor:
    """L_fast = rho L_PRF + (1 - rho) L_FM, of any one shape."""
    check_range("rho", rho, ge=0, le=1)
    return rho * reflow + (1 - rho) * flow
