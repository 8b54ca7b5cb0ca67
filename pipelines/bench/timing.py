"""Timing passes of a GeoVerse model, whole and by stage, and counting their FLOPs."""

from __future__ import annotations

import gc
import statistics
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.model import LEVEL0, LEVEL1, GeoVerse, no_clock
from gvtools.completers.geoverse.video_prior import VideoFeatures
from gvtools.networks.compute import autocast
from pipelines.bench.stage_clock import StageClock, seconds, total

PASS = "pass"
BETWEEN = "between stages"
# torch counts attention on a GPU, not the kernel that it takes on a CPU.
CPU_ATTENTION = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu


@dataclass(frozen=True)
class Times:
    """Seconds by row of the stage table, a whole pass under ``PASS``.

    Attributes:
        median: over the passes.
        least: likewise.
    """

    median: dict[str, float]
    least: dict[str, float]


class TimedPass:
    """A pass of a model over fixed views.

    Args:
        model: on ``device``.
        batch: likewise.
        bounds: of the level-1 steps.
        cascade_bounds: of the cascade's.
        dtype: of products.
        video: features that stand in for the video prior's.
    """

    def __init__(
        self,
        model: GeoVerse,
        batch: ViewBatch,
        *,
        bounds: Sequence[float],
        cascade_bounds: Sequence[float],
        dtype: torch.dtype = torch.float32,
        video: VideoFeatures | None = None,
    ) -> None:
        self.model, self.batch, self.video = model, batch, video
        self.bounds, self.cascade_bounds = tuple(bounds), tuple(cascade_bounds)
        self.dtype = dtype
        self.device = batch.images.device
        self.now = seconds(self.device)
        # How often the stages with numbered steps are stepped through.
        self.steps = {LEVEL1: len(self.bounds) - 1, LEVEL0: len(self.cascade_bounds) - 1}

    def precision(self) -> AbstractContextManager[Any]:
        """Autocast where products are rounded."""
        return autocast(self.device, self.dtype)

    def run(self, clock: StageClock | None = None) -> float:
        """One pass; the seconds it took."""
        self.model.clock = clock or no_clock
        start = self.now()
        with self.precision():
            self.model.generate(
                self.batch,
                bounds=self.bounds,
                cascade_bounds=self.cascade_bounds,
                video=self.video,
            )
        return self.now() - start

    def flops(self) -> dict[str, float]:
        """FLOPs by row of the stage table, counted in one pass.

        A multiplication and an addition count as two. Products, convolutions and attention are
        counted; what is done to single numbers (norms, activations, gates) is not.
        """
        attention = {CPU_ATTENTION: _attention_flops}
        with FlopCounterMode(display=False, custom_mapping=attention) as counter:
            clock = StageClock(counter.get_total_flops)
            self.run(clock)
        return clock.rows(self.steps)

    def times(self, repeat: int) -> Times:
        """Passes with a clock; on a GPU, where the clock waits for the device, also without."""
        found: dict[str, list[float]] = {}
        for _ in range(repeat):
            gc.collect()
            clock = StageClock(self.now)
            whole = self.run(clock)
            rows = clock.rows(self.steps)
            rows[BETWEEN] = whole - total(rows)
            rows[PASS] = self.run() if self.device.type == "cuda" else whole
            for name, spent in rows.items():
                found.setdefault(name, []).append(spent)
        return Times(
            {name: statistics.median(values) for name, values in found.items()},
            {name: min(values) for name, values in found.items()},
        )


def _attention_flops(q: torch.Size, k: torch.Size, v: torch.Size, *_: Any, **options: Any) -> int:
    return int(sdpa_flop_count(q, k, v))
