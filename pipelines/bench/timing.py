"""Timing passes of a GeoVerse model, whole and by stage, and its attention against explicit one."""

from __future__ import annotations

import gc
import os
import statistics
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gvtools.completers.geoverse import denoiser_blocks, shared_attention
from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.stages import LEVEL0, LEVEL1, no_clock
from gvtools.completers.geoverse.video_prior.prior import VideoFeatures
from pipelines.bench.side_by_side import Comparison, alternate, compared
from pipelines.bench.stage_clock import StageClock, seconds, total

PASS = "pass"
BETWEEN = "between stages"
EXPLICIT = "explicit attention"
# Scores, their exponentials and one more copy are alive at once.
SCORE_COPIES = 3


@dataclass(frozen=True)
class Times:
    """Seconds by row of the stage table, a whole pass under ``PASS``.

    Attributes:
        median: over the passes.
        least: likewise.
        repeats: passes.
    """

    median: dict[str, float] = field(default_factory=dict)
    least: dict[str, float] = field(default_factory=dict)
    repeats: int = 0


class TimedPass:
    """A pass of a model over fixed views.

    Args:
        model: on ``device``.
        batch: likewise.
        bounds: of the level-1 steps.
        cascade_bounds: of the cascade's.
        rounded: products in bfloat16.
        video: features that stand in for the video prior's.
    """

    def __init__(
        self,
        model: GeoVerse,
        batch: ViewBatch,
        *,
        bounds: Sequence[float],
        cascade_bounds: Sequence[float],
        rounded: bool = False,
        video: VideoFeatures | None = None,
    ) -> None:
        self.model, self.batch, self.video = model, batch, video
        self.bounds, self.cascade_bounds = tuple(bounds), tuple(cascade_bounds)
        self.rounded = rounded
        self.device = batch.images.device
        self.now = seconds(self.device)

    def precision(self) -> AbstractContextManager[Any]:
        """Autocast where products are rounded."""
        if not self.rounded:
            return nullcontext()
        return torch.autocast(self.device.type, dtype=torch.bfloat16)

    def run(self, clock: StageClock | None = None) -> float:
        """One pass; the seconds it took."""
        start = self.now()
        with self.precision():
            self.model.generate(
                self.batch,
                bounds=self.bounds,
                cascade_bounds=self.cascade_bounds,
                video=self.video,
                clock=clock or no_clock,
            )
        return self.now() - start

    def times(self, repeat: int) -> Times:
        """Passes with a clock; on a GPU, where the clock waits for the device, also without."""
        steps = {LEVEL1: len(self.bounds) - 1, LEVEL0: len(self.cascade_bounds) - 1}
        found: dict[str, list[float]] = {}
        for _ in range(repeat):
            gc.collect()
            clock = StageClock(self.now)
            whole = self.run(clock)
            rows = clock.rows(steps)
            rows[BETWEEN] = whole - total(rows)
            rows[PASS] = self.run() if self.device.type == "cuda" else whole
            for name, spent in rows.items():
                found.setdefault(name, []).append(spent)
        return Times(
            {name: statistics.median(values) for name, values in found.items()},
            {name: min(values) for name, values in found.items()},
            repeat,
        )


@torch.no_grad()
def compare_attention(timed: TimedPass, *, repeat: int) -> Comparison | str:
    """A level-1 step with fused attention against one with explicit scores; or why not."""
    model, config = timed.model, timed.model.config.level1
    with timed.precision():
        prepared = model.prepare(timed.batch, video=timed.video)
    like = prepared.hints.level1
    tokens = like.shape[1] * like.shape[-2] * like.shape[-1]
    needed = SCORE_COPIES * max(config.heads, config.head_heads) * tokens**2 * 4
    if needed > free_bytes(timed.device):
        return f"not compared: explicit scores take up to {needed / 1e9:.1f} GB"
    generator = torch.Generator().manual_seed(1)
    state = torch.randn(like.shape, generator=generator).to(timed.device)
    t = torch.full((len(state),), 0.7, device=timed.device)

    def fused(_: int) -> Tensor:
        with timed.precision():
            velocity = model.velocity1(prepared, state, t)
        timed.now()
        return velocity

    def explicit(turn: int) -> Tensor:
        with explicit_attention():
            return fused(turn)

    ours, theirs = fused(0).float(), explicit(0).float()
    apart = (ours - theirs).abs().max() / ours.abs().max()
    ours_s, explicit_s = alternate([fused, explicit], repeat, steady=True)
    name = f"level-1 step, {tokens:,} tokens, fused attention"
    note = f"they differ by at most {float(apart):.1e} of the largest velocity"
    return compared(name, EXPLICIT, ours_s, peer_s=explicit_s, note=note)


@contextmanager
def explicit_attention() -> Iterator[None]:
    """Let the denoisers spell their attention out."""
    kept = denoiser_blocks.attend

    def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        return ((q * q.shape[-1] ** -0.5) @ k.mT).softmax(-1) @ v

    denoiser_blocks.attend = shared_attention.attend = attend
    try:
        yield
    finally:
        denoiser_blocks.attend = shared_attention.attend = kept


def free_bytes(device: torch.device) -> int:
    """Memory that is not in use; 0 where the system does not tell."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return 0
