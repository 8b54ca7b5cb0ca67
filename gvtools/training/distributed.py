"""One process or several: who does what, and what each holds of a stage in training.

``Replicated`` is a copy of everything on each process; ``sharded.Sharded`` has the same methods
for processes that share the parameters out among them.
"""

from __future__ import annotations

import importlib
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from gvtools.completers.geoverse.model import GeoVerse
from gvtools.errors import OptionError
from gvtools.training.stages import Stage

# More rounds than a group has threads.
SETTLING_ROUNDS = 4
SETTLING_SECONDS = 0.1


@dataclass(frozen=True)
class Processes:
    """The group that ``torchrun`` started, or one process alone."""

    rank: int  # number of this process
    count: int  # how many there are
    device: torch.device  # of this process

    @property
    def first(self) -> bool:
        """Whether this process writes."""
        return self.rank == 0

    def share(self, samples: range) -> range:
        """This process's part of a step's samples; contiguous, equal for all."""
        if len(samples) % self.count:
            raise OptionError(
                f"a batch of {len(samples)} samples over {self.count} processes; expected a "
                "multiple; change optimizer.batch"
            )
        size = len(samples) // self.count
        start = samples.start + self.rank * size
        return range(start, start + size)

    @torch.no_grad()
    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Mean of the gradients over all processes; absent ones count as zero."""
        if self.count == 1:
            return
        wanted = [p for p in parameters if p.requires_grad]
        # One flat buffer a dtype: few messages, and a fixed order of the sums.
        flat = torch.cat(
            [(p.grad if p.grad is not None else torch.zeros_like(p)).flatten() for p in wanted]
        )
        dist.all_reduce(flat)
        flat /= self.count
        start = 0
        for parameter in wanted:
            size = parameter.numel()
            parameter.grad = flat[start : start + size].view_as(parameter).clone()
            start += size

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Means of numbers over all processes."""
        if self.count == 1 or not values:
            return values
        names = sorted(values)
        packed = torch.tensor([values[name] for name in names], dtype=torch.float64)
        packed = packed.to(self.device if dist.get_backend() == "nccl" else "cpu")
        dist.all_reduce(packed)
        return dict(zip(names, (packed / self.count).tolist(), strict=True))

    def total(self, counts: Mapping[str, int]) -> Counter[str]:
        """Sums of counts over all processes, which need not have the same names."""
        if self.count == 1:
            return Counter(counts)
        found: list[Any] = [None] * self.count
        dist.all_gather_object(found, dict(counts))
        total: Counter[str] = Counter()
        for each in found:
            total.update(each)
        return total

    def any(self, flag: bool) -> bool:
        """Whether it is so in any process."""
        if self.count == 1:
            return flag
        value = Tensor([float(flag)])
        value = value.to(self.device if dist.get_backend() == "nccl" else "cpu")
        dist.all_reduce(value, op=dist.ReduceOp.MAX)
        return bool(value.item())

    def wait(self) -> None:
        """Until all processes are here."""
        self.any(False)


@contextmanager
def join_processes(device: str = "auto") -> Iterator[Processes]:
    """The processes of this training; joins the group that ``torchrun`` describes.

    ``device``: "auto", "cpu" or "cuda".
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise OptionError("device cuda, and torch sees no CUDA device here; use cpu")
    use_cuda = device != "cpu" and torch.cuda.is_available()
    count = int(os.environ.get("WORLD_SIZE", "1"))
    rank = int(os.environ.get("RANK", "0"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    place = torch.device("cuda", local) if use_cuda else torch.device("cpu")
    if count == 1:
        yield Processes(0, 1, place)
        return
    if use_cuda:
        torch.cuda.set_device(place)
    # Imported later, it would keep the group, and so the group's threads, to the process's end.
    importlib.import_module("torch.distributed.fsdp")
    dist.init_process_group("nccl" if use_cuda else "gloo")
    try:
        yield Processes(rank, count, place)
        _settle()
    finally:
        dist.destroy_process_group()


def _settle() -> None:
    """Let the group's threads drop the last tensors.

    Caches of sharded tensors keep the group beyond its end. A thread of it that drops a tensor
    while the interpreter shuts down aborts the process.
    """
    for _ in range(SETTLING_ROUNDS):
        dist.barrier()
    time.sleep(SETTLING_SECONDS)


class Replicated:
    """All parameters, gradients, averages and moments on every process."""

    # Whether all processes have to take part in whatever the model does.
    collective = False
    # For the user; empty where there is nothing to say.
    about = ""

    def __init__(self, stage: Stage, processes: Processes) -> None:
        self.stage, self.processes = stage, processes
        self._distribute()

    def _distribute(self) -> None:
        device = self.processes.device
        self.stage.to(device)
        for model in models_of(self.stage):
            model.to(device)
            if model.video is not None:
                model.video.to(device)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Mean of the gradients over all processes."""
        self.processes.average_gradients(parameters)

    def number(self, norm: Tensor) -> float:
        """A norm over all parameters."""
        return float(norm)

    def gather(self, state: Any) -> Any:
        """Nested dictionaries and lists with whole tensors; for the first process alone."""
        return state

    def place(self, whole: Tensor, like: Tensor) -> Tensor:
        """What a process holds of a whole tensor, as it does of ``like``."""
        return whole

    @contextmanager
    def usable(self) -> Iterator[None]:
        """Within the block, the model may be used outside of the stage's ``forward``."""
        yield

    def whole_model(self, model: GeoVerse) -> GeoVerse | None:
        """The model with whole tensors; None on all processes but the first."""
        return model if self.processes.first else None


def models_of(stage: nn.Module) -> list[GeoVerse]:
    """The models that a stage uses: its own, and those that it keeps in a list.

    What lies in a list is no part of a module's state: the teacher of the distillation.
    """
    listed = [item for value in vars(stage).values() if isinstance(value, list) for item in value]
    return [model for model in (*stage.children(), *listed) if isinstance(model, GeoVerse)]
