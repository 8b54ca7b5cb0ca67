"""What the stages of a pass take: seconds, FLOPs, or anything else of which a total grows."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import torch

from gvtools.completers.geoverse.model import DECODE, DECODING

# Before the name of a part of the decoding.
INSIDE = f"{DECODE}: "


class StageClock:
    """Given to a model as its clock, it notes by how much ``total`` grows within each stage.

    Args:
        total: a number that never falls.

    Attributes:
        entries: (stage, growth) in the order in which stages began.
    """

    def __init__(self, total: Callable[[], float]) -> None:
        self.total = total
        self.entries: list[tuple[str, float]] = []

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Note one stage."""
        place = len(self.entries)
        self.entries.append((stage, 0.0))
        before = self.total()
        yield
        self.entries[place] = (stage, self.total() - before)

    def rows(self, steps: Mapping[str, int]) -> dict[str, float]:
        """Growth by row of the stage table; of several evaluations a step, their sum.

        Args:
            steps: how often stages with numbered steps are stepped through.
        """
        found: dict[str, list[float]] = {}
        for stage, growth in self.entries:
            found.setdefault(stage, []).append(growth)
        rows = {}
        for stage, values in found.items():
            if stage not in steps:
                rows[f"{INSIDE}{stage}" if stage in DECODING else stage] = sum(values)
                continue
            share = len(values) // steps[stage]
            for step in range(steps[stage]):
                rows[f"{stage} {step + 1}"] = sum(values[step * share : (step + 1) * share])
        return rows


def within(name: str) -> bool:
    """A row is a part of another one."""
    return name.startswith(INSIDE)


def total(rows: Mapping[str, float]) -> float:
    """Of all rows; what is within another row is not counted twice."""
    return sum(value for name, value in rows.items() if not within(name))


def seconds(device: torch.device) -> Callable[[], float]:
    """Wall time in s, after all that was asked of the device is done."""

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    return now


# What ``peak_bytes`` is, by the device's type.
PEAK = {
    "cuda": "what tensors held on the device, weights included",
    "cpu": "the most that the process ever held",
}


def forget_peak(device: torch.device) -> None:
    """Before what ``peak_bytes`` is asked for."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_bytes(device: torch.device) -> int:
    """See ``PEAK``."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
