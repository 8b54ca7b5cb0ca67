"""The training loop of any stage: batches in, optimiser steps, checkpoints, logs; exact to resume.

A step's samples and draws follow from its number alone, so that a training continues after a kill
as if nothing had been, and several processes see together what one would see.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from gvtools.training.batch import TrainingBatch
from gvtools.training.draws import Draws
from gvtools.training.ema import AveragedWeights
from gvtools.training.options import OptimizerOptions
from gvtools.training.processes import Processes
from gvtools.training.state import Progress, StageState, load_state, save_state


class Stage(Protocol):
    """A module whose ``forward`` gives the loss of a batch and its terms."""

    name: str

    def __call__(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss and what is logged beside it."""
        ...


Batches = Callable[[range], TrainingBatch]


@dataclass(frozen=True)
class Reporting:
    """When and to whom the loop reports.

    Attributes:
        log_every: steps between records.
        save_seconds: seconds between checkpoints.
        sheet_every: steps between sample sheets; 0 for none.
        record: gets (step, values).
        sheet: gets the step; the averaged weights are in place meanwhile.
    """

    log_every: int = 20
    save_seconds: float = 60.0
    sheet_every: int = 0
    record: Callable[[int, dict[str, float]], None] = lambda step, values: None
    sheet: Callable[[int], None] = lambda step: None


class Trainer:
    """One stage in training.

    Args:
        stage: see Stage; what it leaves trainable is trained.
        options: of the optimiser.
        batches: gives the samples with these numbers.
        folder: of the state.
        seed: of the draws.
        identity: what may not change when a training is continued.
        processes: this process and the others.
    """

    def __init__(
        self,
        stage: nn.Module,
        options: OptimizerOptions,
        batches: Batches,
        *,
        folder: Path,
        seed: int,
        identity: dict[str, Any],
        processes: Processes,
    ) -> None:
        self.stage, self.options, self.batches = stage, options, batches
        self.folder, self.seed, self.identity = folder, seed, identity
        self.processes = processes
        self.parameters = [(n, p) for n, p in stage.named_parameters() if p.requires_grad]
        matrices = [p for _, p in self.parameters if p.ndim > 1]
        others = [p for _, p in self.parameters if p.ndim <= 1]
        self.optimizer = torch.optim.AdamW(
            [
                {"params": matrices, "weight_decay": options.weight_decay},
                {"params": others, "weight_decay": 0.0},
            ],
            lr=options.rate,
            betas=options.betas,
        )
        self.ema = AveragedWeights(self.parameters, options.ema)
        self.progress = Progress()

    def resume(self) -> bool:
        """Continue from the saved state; False where there is none."""
        state = load_state(self.folder, self.identity)
        if state is None:
            return False
        with torch.no_grad():
            for name, parameter in self.parameters:
                parameter.copy_(state.model[name])
        self.optimizer.load_state_dict(state.optimizer)
        self.ema.load_state_dict(state.ema)
        self.progress = state.progress
        return True

    def save(self) -> None:
        """Write the state, from the first process."""
        if not self.processes.first:
            return
        state = StageState(
            self.identity,
            self.progress,
            {name: parameter.detach().cpu() for name, parameter in self.parameters},
            self.optimizer.state_dict(),
            self.ema.state_dict(),
        )
        save_state(state, self.folder)

    def train(self, reporting: Reporting, *, until: int | None = None) -> None:
        """Make steps up to ``until`` (all of them by default) and save at the end."""
        last = min(until or self.options.steps, self.options.steps)
        saved = begun = time.monotonic()
        before = self.progress.seconds
        kept: list[dict[str, float]] = []
        while self.progress.step < last:
            kept.append(self.step())
            self.progress.seconds = before + time.monotonic() - begun
            step = self.progress.step
            if step % reporting.log_every == 0 or step == last:
                values = self.processes.mean(_averaged(kept))
                values |= {
                    "rate": self.rate(step - 1),
                    "skipped": float(self.progress.skipped),
                    "seconds": self.progress.seconds,
                }
                if self.processes.first:
                    reporting.record(step, values)
                kept = []
            if reporting.sheet_every and step % reporting.sheet_every == 0 and self.processes.first:
                with self.ema.swapped_in(), torch.no_grad():
                    reporting.sheet(step)
            if time.monotonic() - saved > reporting.save_seconds:
                self.save()
                saved = time.monotonic()
        self.save()

    def step(self) -> dict[str, float]:
        """One optimiser step; returns what it logs. A bad batch is skipped and counted."""
        options, number = self.options, self.progress.step
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate(number)
        start = number * options.batch
        mine = self.processes.share(range(start, start + options.batch))
        values: list[dict[str, float]] = []
        good = True
        for part in _parts(mine, options.accumulate):
            batch = self.batches(part).to(self.processes.device)
            draws = Draws(self.seed, str(self.stage.name), number, tuple(part))
            with self._precision():
                loss, terms = self.stage(batch, draws)
            value = float(loss.detach())
            good &= math.isfinite(value) and value <= options.largest_loss
            if not good:
                break
            (loss * (len(part) / len(mine))).backward()
            values.append({"loss": value} | {k: float(v.detach()) for k, v in terms.items()})
        trained = [parameter for _, parameter in self.parameters]
        bad = self.processes.any(not good)
        if not bad:
            self.processes.average_gradients(trained)
            norm = nn.utils.clip_grad_norm_(trained, options.clip)
            bad = not bool(torch.isfinite(norm))
        if bad:
            self.progress.skipped += 1
            values = []
        else:
            self.optimizer.step()
            self.ema.update()
            values.append({"gradient_norm": float(norm)})
        self.optimizer.zero_grad(set_to_none=True)
        self.progress.step += 1
        return _averaged(values)

    def rate(self, step: int) -> float:
        """The learning rate of a step."""
        options = self.options
        warm = max(1, round(options.warmup * options.steps))
        if step < warm:
            return options.rate * (step + 1) / warm
        if options.schedule == "constant":
            return options.rate
        share = (step - warm) / max(1, options.steps - warm)
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, share)))
        return options.rate * (options.final + (1 - options.final) * cosine)

    def _precision(self):  # type: ignore[no-untyped-def]
        if self.options.precision == "float32":
            return nullcontext()
        return torch.autocast(self.processes.device.type, dtype=torch.bfloat16)


def _parts(samples: range, count: int) -> list[range]:
    """Contiguous parts, as equal as can be."""
    count = min(count, len(samples))
    ends = [samples.start + round(i * len(samples) / count) for i in range(count + 1)]
    return [range(a, b) for a, b in pairwise(ends)]


def _averaged(values: Sequence[dict[str, float]]) -> dict[str, float]:
    """Mean of every key over the records that have it."""
    names = {name for record in values for name in record}
    return {
        name: sum(r[name] for r in values if name in r) / sum(name in r for r in values)
        for name in sorted(names)
    }
