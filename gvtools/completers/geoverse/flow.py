"""Flow matching on a straight path: times, Euler steps, starting noise, and piecewise reflow.

x_t = (1 - t) clean + t noise, velocity u = dx/dt = noise - clean. A time shift s spends more of the
steps near the noise, t' = s t / (1 + (s - 1) t). Shapes: states (B, ...), usually latents
(B, V, C, h, w); one t a sample, shared by its views.

In reflow a student learns the teacher's displacement over each interval as one step (Section
"Few-Step Inference via Reflow Distillation" of the paper, after PeRFlow, Yan et al. 2024). The
bounds 1 = tau_0 > ... > tau_K = 0 cut time into intervals a = 0 .. K-1 of upper end tau_a and lower
end tau_{a+1}. The loss is ``objective.flow_matching_loss`` with the velocity given here.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import torch
from torch import Tensor

from gvtools.errors import OptionError
from gvtools.networks.compute import on_device

Time = TypeVar("Time", float, Tensor)
Velocity = Callable[[Tensor, Tensor], Tensor]

# Geometric Latent Diffusion stops here, before its shift.
GLD_END = 0.001
# A shift beyond it, or below its inverse, puts all times within rounding of an end.
MOST_SHIFT = 1e6
# That draw noise.
MOST_THREADS = 8


def shift_time(t: Time, shift: float) -> Time:
    """Uniform time to shifted time; 0 and 1 stay, ``shift`` 1 changes nothing."""
    # 1 + (s - 1) t, written so that nothing cancels and t = 1 gives s to the last digit.
    return shift * t / (1 if shift == 1 else (1 - t) + shift * t)


def unshift_time(t: Time, shift: float) -> Time:
    """The inverse of ``shift_time``."""
    return shift_time(t, 1 / shift)


def latent_shift(values: int, *, base: int = 4096) -> float:
    """Geometric Latent Diffusion's shift sqrt(values / base), of values = C h w V a sample."""
    return math.sqrt(values / base)


def time_grid(steps: int, *, shift: float = 1.0, end: float = 0.0) -> tuple[float, ...]:
    """``steps`` + 1 falling times from 1 to ``end``, equally spaced before the shift."""
    first, last = unshift_time(1.0, shift), unshift_time(end, shift)
    inner = (first + (last - first) * k / steps for k in range(1, steps))
    times = (1.0, *(shift_time(u, shift) for u in inner), end)
    if not all(later < earlier for earlier, later in pairwise(times)):
        raise OptionError(
            f"time grid: {steps} steps from 1.0 to {end} at shift {shift} lie nearer to each "
            "other than rounding; take fewer, or a shift nearer to 1"
        )
    return times


def gld_time_grid(points: int, *, shift: float) -> tuple[float, ...]:
    """Geometric Latent Diffusion's ``points`` times, which end above 0: some noise stays."""
    return time_grid(points - 1, shift=shift, end=shift_time(GLD_END, shift))


def check_bounds(bounds: Sequence[float], *, whole: bool = False) -> tuple[float, ...]:
    """K + 1 bounds as floats; a ``whole`` list has to end at 0, where no noise is left."""
    tau = tuple(float(bound) for bound in bounds)
    falls = len(tau) > 1 and all(later < earlier for earlier, later in pairwise(tau))
    if not falls or tau[0] != 1 or tau[-1] < 0 or (whole and tau[-1] > 0):
        raise OptionError(
            f"interval bounds {list(tau)}; expected 1 = tau_0 > tau_1 > ... > tau_K "
            f"{'=' if whole else '>='} 0"
        )
    return tau


def training_times(uniform: Tensor, *, shift: float = 1.0, most: float = 1.0) -> Tensor:
    """Training times (B,) of uniform draws (B,) in [0, 1): scaled to [0, ``most``), then shifted.

    The paper's t ~ U(0, 1) is 1 and 1; Geometric Latent Diffusion has 0.999 and ``latent_shift``.
    """
    return shift_time(uniform * most, shift)


def over_state(t: float | Tensor, state: Tensor) -> float | Tensor:
    """A time (B,) in the shape that multiplies ``state`` (B, ...); a number stays a number."""
    if not isinstance(t, Tensor):
        return t
    return t.reshape(t.shape + (1,) * (state.ndim - t.ndim))


def interpolate(clean: Tensor, noise: Tensor, t: float | Tensor) -> Tensor:
    """x_t (B, ...) in the dtype of ``clean``, at t, a number or (B,)."""
    t = over_state(t, clean)
    return ((1 - t) * clean + t * noise).to(clean.dtype)


def velocity_target(clean: Tensor, noise: Tensor) -> Tensor:
    """The path's velocity noise - clean (B, ...), the same at every t."""
    return noise - clean


def clean_from_velocity(velocity: Tensor, state: Tensor, t: float | Tensor) -> Tensor:
    """The clean state x_t - t u (B, ...) that a predicted velocity points back to."""
    return (state - over_state(t, state) * velocity).to(state.dtype)


def velocity_from_clean(
    clean: Tensor, state: Tensor, t: float | Tensor, *, least: float = 0.05
) -> Tensor:
    """The velocity (x_t - clean) / max(t, least) (B, ...) of a prediction of the clean state.

    As t falls to 0, ``least`` keeps the prediction's errors from growing beyond 1 / least.
    """
    time = over_state(t, state)
    time = time.clamp(min=least) if isinstance(time, Tensor) else max(time, least)
    return ((state - clean) / time).to(state.dtype)


def guide(both: Velocity, scale: float) -> Velocity:
    """Classifier-free guidance u = unconditional + scale (conditional - unconditional).

    ``both`` takes a batch twice in one, first without the condition; at a scale of 1 once.
    """
    if scale == 1:
        return both

    def combined(state: Tensor, t: Tensor) -> Tensor:
        without, given = both(torch.cat((state, state)), torch.cat((t, t))).chunk(2)
        return without + scale * (given - without)

    return combined


def integrate(
    velocity: Velocity,  # of (B, ...) and t (B,), returns (B, ...)
    state: Tensor,  # (B, ...) at the first time
    times: Sequence[float] | Tensor,  # (S + 1,), or (S + 1, B) for times of each sample's own
) -> Tensor:
    """Euler steps of dx/dt = velocity(x, t) along ``times``; the state at the last one.

    The state is carried in float32 at least, so that small steps do not vanish in bfloat16; the
    network receives it in its own dtype, that of the result (infinite beyond float16's 65504).
    """
    wide = torch.promote_types(state.dtype, torch.float32)
    grid = torch.as_tensor(times, dtype=torch.float64, device="cpu")
    grid = grid.reshape(len(grid), -1).expand(-1, len(state))
    strides, at = (on_device(x.to(wide), state.device) for x in (grid.diff(dim=0), grid))
    current = state.to(wide)
    for step in range(len(strides)):
        u = velocity(current.to(state.dtype), at[step])
        current = current + over_state(strides[step], current) * u.to(wide)
    return current.to(state.dtype)


def sample(
    velocity: Velocity,
    noise: Tensor,  # (B, ...), the state at t = 1
    bounds: Sequence[float],  # K + 1 times, see ``check_bounds``; the last is 0 in GeoVerse
) -> Tensor:  # The state (B, ...) at the last bound
    """From noise to clean with one Euler step an interval."""
    return integrate(velocity, noise, check_bounds(bounds))


def view_seed(seed: int, *names: int | str) -> int:
    """A seed in [0, 2^63) of a run's seed and the draw's names, such as ("level1", "frame_7")."""
    text = json.dumps([int(seed), *names]).encode("utf-8")
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "big") >> 1


def seeded_noise(
    shape: Sequence[int],  # (B, V, C, h, w); anything after B, V
    seeds: Sequence[Sequence[int]],  # B rows of V seeds, see ``view_seed``
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Standard normal noise, drawn view by view in float32 on the CPU."""
    return on_device(drawn_noise(shape, seeds), device, dtype=dtype)


def drawn_noise(shape: Sequence[int], seeds: Sequence[Sequence[int]]) -> Tensor:
    """``seeded_noise`` on the CPU; each view is drawn on a thread of its own."""

    def drawn(seed: int) -> Tensor:
        return torch.randn(tuple(shape[2:]), generator=torch.Generator().manual_seed(seed))

    values = [value for row in seeds for value in row]
    if not values:
        return torch.empty(tuple(shape))
    with ThreadPoolExecutor(min(len(values), MOST_THREADS)) as threads:
        return torch.stack(list(threads.map(drawn, values))).reshape(tuple(shape))


@dataclass(frozen=True, eq=False)
class ReflowPair:
    """One batch of what a student learns from."""

    # (B, ...) X~_t = eta X+ + (1 - eta) X-, between the noisy end X+ of the interval and its
    # cleaner end X-, eta = (t - tau_{a+1}) / (tau_a - tau_{a+1}).
    state: Tensor
    t: Tensor  # (B,) float32, its time
    velocity: Tensor  # (B, ...) u^T_a = (X+ - X-) / (tau_a - tau_{a+1}), that line's velocity


def interval_ends(intervals: Tensor, bounds: Sequence[float]) -> tuple[Tensor, Tensor]:
    """tau_a and tau_{a+1} of each interval (B,) int64: two (B,) float64 on the CPU."""
    tau = torch.tensor(check_bounds(bounds), dtype=torch.float64)
    index = intervals.cpu()
    return tau[index], tau[index + 1]


def interval_times(which: Tensor, share: Tensor, bounds: Sequence[float]) -> tuple[Tensor, Tensor]:
    """An interval (B,) int64, each as likely, and t ~ U(tau_{a+1}, tau_a) (B,) float32; on the CPU.

    ``which`` and ``share`` (B,) are uniform draws in [0, 1) of the interval and the place in it.
    """
    count = len(check_bounds(bounds)) - 1
    intervals = (which * count).long().clamp(max=count - 1)
    upper, lower = interval_ends(intervals, bounds)
    return intervals, (lower + share * (upper - lower)).float()


def teacher_times(upper: Tensor, lower: Tensor, *, steps: int, shift: float = 1.0) -> Tensor:
    """(steps + 1, B) times from ``upper`` to ``lower`` (B,), equally spaced before the shift."""
    share = torch.linspace(0, 1, steps + 1, dtype=upper.dtype, device=upper.device)[:, None]
    times = shift_time(
        torch.lerp(unshift_time(upper, shift), unshift_time(lower, shift), share), shift
    )
    times[0], times[-1] = upper, lower
    return times


def reflow_pair(
    # The many-step velocity of (B, ...) and t (B,); with guidance, see ``guide``.
    teacher: Velocity,
    clean: Tensor,  # (B, ...) reference latents F^1
    noise: Tensor,  # (B, ...)
    *,
    intervals: Tensor,  # (B,) int64, a
    t: Tensor,  # (B,) in each interval, see ``interval_times``
    bounds: Sequence[float],  # tau_0 .. tau_K
    steps: int,  # of the teacher in each interval
    shift: float = 1.0,  # of the teacher's time, see ``shift_time``
) -> ReflowPair:
    """Run the frozen teacher through one interval a sample and draw the straight line."""
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
