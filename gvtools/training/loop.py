"""The training loop of any stage: optimiser steps, averages, checkpoints; exact to resume.

A step's samples and draws follow from its number alone, so that a training continues after a kill
as if nothing had been, and several processes see together what one would see. What is saved does
not depend on the processes either.
"""

from __future__ import annotations

import itertools
import math
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.errors import CheckpointError, OptionError
from gvtools.files import replaced_when_written
from gvtools.networks.compute import autocast, training_type
from gvtools.networks.tensors import first_line
from gvtools.training.data import RESAMPLED
from gvtools.training.distributed import Replicated
from gvtools.training.options import OptimizerOptions
from gvtools.training.samples import Draws, TrainingBatch
from gvtools.untrusted import archive

Batches = Callable[[Iterable[range]], Generator[TrainingBatch, None, None]]

LOG_EVERY = 20  # steps between records
SAVE_SECONDS = 60.0  # between checkpoints; more where saving takes long:
SAVING_SHARE = 20  # it takes at most one part in so many of the time


class Trainer:
    """One stage in training."""

    def __init__(
        self,
        distributed: Replicated,
        options: OptimizerOptions,
        batches: Batches,
        *,
        folder: Path,
        seed: int,
        identity: dict[str, Any],
    ) -> None:
        self.distributed = distributed
        self.stage, self.processes = distributed.stage, distributed.processes
        self.options, self.batches = options, batches
        self.folder, self.seed, self.identity = folder, seed, identity
        self.parameters = [(n, p) for n, p in self.stage.named_parameters() if p.requires_grad]
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
        self.progress = TrainingProgress()
        # Of this process's samples since they were merged last.
        self._notes: Counter[str] = Counter()
        # Processes of one training have to agree, as a stage that runs has seen to (run.py).
        self.dtype = training_type(options.precision, self.processes.device)

    @property
    def finished(self) -> bool:
        """Whether all steps are made."""
        return self.progress.step >= self.options.steps

    def resume(self) -> bool:
        """Continue from the saved state; False where there is none."""
        state = load_state(self.folder, self.identity, mapped=self.distributed.collective)
        if state is None:
            return False
        with torch.no_grad():
            for name, parameter in self.parameters:
                parameter.copy_(self.distributed.place(state.model[name], parameter))
        self.optimizer.load_state_dict(self._placed_moments(state.optimizer))
        shadow = {
            name: self.distributed.place(state.ema["shadow"][name], value)
            for name, value in self.ema.shadow.items()
        }
        self.ema.load_state_dict({**state.ema, "shadow": shadow})
        self.progress = state.progress
        return True

    def _placed_moments(self, state: dict[str, Any]) -> dict[str, Any]:
        """The optimiser's state with what this process holds of it."""
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        moments = {
            index: {
                name: value if name == "step" else self.distributed.place(value, parameters[index])
                for name, value in entry.items()
            }
            for index, entry in state["state"].items()
        }
        return {**state, "state": moments}

    def save(self) -> None:
        """Write the state, from the first process; called by all of them."""
        self._merge_notes()
        model, optimizer, ema = (
            self.distributed.gather(part)
            for part in (
                {name: parameter.detach() for name, parameter in self.parameters},
                self.optimizer.state_dict(),
                self.ema.state_dict(),
            )
        )
        if self.processes.first:
            save_state(StageState(self.identity, self.progress, model, optimizer, ema), self.folder)

    def _merge_notes(self) -> dict[str, float]:
        """Counts of what happened when samples were drawn; called by all processes."""
        total = Counter(self.progress.drawn)
        total.update(self.processes.total(self._notes))
        self._notes.clear()
        self.progress.drawn = dict(sorted(total.items()))
        counts = {name: float(count) for name, count in self.progress.drawn.items()}
        if counts:
            invalid = sum(n for name, n in total.items() if name.startswith(f"{RESAMPLED}/"))
            counts[RESAMPLED] = float(invalid)
        return counts

    def train(
        self,
        *,
        until: int | None = None,  # step to stop after; None makes all steps
        # gets (step, values), means over all processes
        record: Callable[[int, dict[str, float]], None] | None = None,
        # gets the step, in every process; the averaged weights are in place meanwhile
        sheet: Callable[[int], None] | None = None,
        sheet_every: int = 0,  # steps between sample sheets
    ) -> None:
        """Make steps, and save now and then and at the end."""
        last = min(until or self.options.steps, self.options.steps)
        saved = begun = time.monotonic()
        pause, before = SAVE_SECONDS, self.progress.seconds
        values: list[dict[str, float]] = []
        parts = itertools.chain.from_iterable(map(self.parts, itertools.count(self.progress.step)))
        with closing(self.batches(parts)) as stream:
            while self.progress.step < last:
                values.append(self.step(stream))
                self.progress.seconds = before + time.monotonic() - begun
                step = self.progress.step
                if step % LOG_EVERY == 0 or step == last:
                    means = self.processes.mean(_means(values))
                    means |= {
                        "rate": self.options.rate_at(step - 1),
                        "skipped": float(self.progress.skipped),
                        "seconds": self.progress.seconds,
                        **self._merge_notes(),
                    }
                    if record is not None:
                        record(step, means)
                    values = []
                if sheet is not None and step % sheet_every == 0:
                    with self.ema.swapped_in(), torch.no_grad():
                        sheet(step)
                # The clocks of the processes differ, and all of them save.
                if self.processes.any(time.monotonic() - saved > pause):
                    now = time.monotonic()
                    self.save()
                    saved = time.monotonic()
                    pause = max(SAVE_SECONDS, SAVING_SHARE * (saved - now))
        self.save()

    def parts(self, step: int) -> list[range]:
        """Numbers of the samples of this process's parts of a step."""
        start = step * self.options.batch
        mine = self.processes.share(range(start, start + self.options.batch))
        # Contiguous, as equal as can be.
        count = min(self.options.accumulate, len(mine))
        ends = [mine.start + round(i * len(mine) / count) for i in range(count + 1)]
        return [range(a, b) for a, b in pairwise(ends)]

    def check_parts(self, group: int) -> None:
        """Refuse parts whose samples have different numbers of context views."""
        for part in itertools.chain.from_iterable(map(self.parts, range(group))):
            if part[0] // group != part[-1] // group:
                raise OptionError(
                    f"optimizer.batch = {self.options.batch}, optimizer.accumulate = "
                    f"{self.options.accumulate}, {self.processes.count} process(es): one part "
                    f"would hold samples {part[0]} to {part[-1]}, whose numbers of context views "
                    f"differ; expected parts within {group} samples, such as a batch of 1, 2, 4 or "
                    f"{group}, or a multiple of {group} in as many parts"
                )

    def step(self, stream: Iterator[TrainingBatch]) -> dict[str, float]:
        """One optimiser step; returns what it logs. A bad batch is skipped and counted."""
        options, number = self.options, self.progress.step
        for group in self.optimizer.param_groups:
            group["lr"] = options.rate_at(number)
        values: list[dict[str, float]] = []
        good = True
        parts = self.parts(number)
        count = sum(map(len, parts))
        for part in parts:
            batch = next(stream).to(self.processes.device)
            self._notes.update(batch.notes)
            draws = Draws(self.seed, self.stage.name, number, tuple(part))
            with autocast(self.processes.device, self.dtype):
                loss, terms = self.stage(batch, draws)
            value = float(loss.detach())
            good &= math.isfinite(value) and value <= options.largest_loss
            # Of a bad loss, too: processes that share parameters out meet in the backward pass.
            (loss * (len(part) / count)).backward()
            values.append({"loss": value} | {k: float(v.detach()) for k, v in terms.items()})
        trained = [parameter for _, parameter in self.parameters]
        bad = self.processes.any(not good)
        if not bad:
            self.distributed.average_gradients(trained)
            norm = self.distributed.number(nn.utils.clip_grad_norm_(trained, options.clip))
            bad = not math.isfinite(norm)
        if bad:
            self.progress.skipped += 1
            values = []
        else:
            self.optimizer.step()
            self.ema.update()
            values.append({"gradient_norm": norm})
        self.optimizer.zero_grad(set_to_none=True)
        self.progress.step += 1
        return _means(values)


def _means(values: Sequence[dict[str, float]]) -> dict[str, float]:
    """Mean of every key over the records that have it."""
    names = {name for record in values for name in record}
    return {
        name: sum(r[name] for r in values if name in r) / sum(name in r for r in values)
        for name in sorted(names)
    }


class AveragedWeights:
    """Averages of named parameters, shadow = decay shadow + (1 - decay) parameter.

    The first updates average faster, (1 + n) / (10 + n) up to the decay, so that a short training
    is not dominated by its start.
    """

    def __init__(self, parameters: Iterable[tuple[str, nn.Parameter]], decay: float) -> None:
        self.decay = decay
        self.updates = 0
        self._parameters = dict(parameters)
        self.shadow = {name: p.detach().clone() for name, p in self._parameters.items()}

    @torch.no_grad()
    def update(self) -> None:
        """Take one step of the parameters into account."""
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        self.updates += 1
        names = list(self.shadow)
        torch._foreach_lerp_(
            [self.shadow[name] for name in names],
            [self._parameters[name].detach() for name in names],
            1 - decay,
        )

    @contextmanager
    def swapped_in(self) -> Iterator[None]:
        """The parameters hold their averages within the block."""
        own = {name: p.detach().clone() for name, p in self._parameters.items()}
        self._put(self.shadow)
        try:
            yield
        finally:
            self._put(own)

    @torch.no_grad()
    def _put(self, values: Mapping[str, Tensor]) -> None:
        for name, parameter in self._parameters.items():
            parameter.copy_(values[name])

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"updates": self.updates, "shadow": self.shadow}

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """From a checkpoint."""
        self.updates = int(state["updates"])
        for name, value in self.shadow.items():
            value.copy_(state["shadow"][name])


FILE = "state.pt"


@dataclass
class TrainingProgress:
    """Where a stage is."""

    step: int = 0  # optimiser steps made; the next sample is ``step`` x batch
    skipped: int = 0  # batches that were left out, not finite or too large
    seconds: float = 0.0  # spent so far
    # how often what happened when samples of a mixture were drawn, by note
    drawn: dict[str, int] = field(default_factory=dict)


@dataclass
class StageState:
    """What is saved."""

    identity: dict[str, Any]  # what must not change between the parts of a training
    progress: TrainingProgress = field(default_factory=TrainingProgress)
    model: dict[str, Any] = field(default_factory=dict)  # trainable parameters by name
    optimizer: dict[str, Any] = field(default_factory=dict)  # the optimiser's state
    ema: dict[str, Any] = field(default_factory=dict)  # the averages' state


def save_state(state: StageState, folder: Path) -> None:
    """Write the state; a kill or a full disk leaves the previous one whole."""
    content = {**vars(state), "progress": asdict(state.progress)}
    with replaced_when_written(folder / FILE) as part, part.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:
            # Torch's archive writer puts its own error over the system's.
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def load_state(
    folder: Path, identity: dict[str, Any], *, mapped: bool = False
) -> StageState | None:
    """The saved state, or None where there is none."""
    path = folder / FILE
    if not path.exists():
        return None
    try:
        with archive(path):
            pass  # its members claim what they may
        with zipfile.ZipFile(path) as members:
            # Torch's reader leaves the CRC-32 of the members out.
            if (damaged := members.testzip()) is not None:
                raise ValueError(f"{damaged} is damaged")
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
        state = StageState(**{**content, "progress": TrainingProgress(**content["progress"])})
    except Exception as error:
        raise CheckpointError(
            f"{path}: cannot be read ({first_line(error)}); start the stage again without --resume"
        ) from None
    difference = _difference(state.identity, identity)
    if difference is not None:
        key, before, now = difference
        raise CheckpointError(
            f"{path}: was trained with {key} = {before!r}, now {now!r}; use the same settings, or "
            "another --out"
        )
    return state


def saved_identity(folder: Path) -> dict[str, Any]:
    """Of the saved state; empty where there is none that can be read, which ``load_state`` says."""
    try:
        with archive(folder / FILE):
            content = torch.load(folder / FILE, map_location="cpu", weights_only=True, mmap=True)
        return dict(content["identity"])
    except Exception:
        return {}


def _difference(before: Any, now: Any, where: str = "") -> tuple[str, Any, Any] | None:
    """The first entry of ``now`` that ``before`` has otherwise: its dotted name and both values."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in now:
            inside = f"{where}.{name}" if where else str(name)
            difference = _difference(before.get(name), now[name], inside)
            if difference is not None:
                return difference
        return None
    return None if before == now else (where, before, now)
