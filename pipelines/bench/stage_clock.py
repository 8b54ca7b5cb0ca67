"""What the stages of a pass take: seconds, FLOPs, or anything else of which a total grows."""

from __future__ import annotations

import ctypes
import gc
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch

from gvtools.completers.geoverse.stages import DECODE, DECODING

STATUS = Path("/proc/self/status")
CLEAR = Path("/proc/self/clear_refs")
FORGET_PEAK = "5"
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


class PeakMemory:
    """Most memory within a ``with`` block.

    On CUDA: what tensors held, weights included. On a CPU: by how much the process grew, which
    Linux alone tells.

    Attributes:
        bytes: known after the block; None where it cannot be told.
        said: what the bytes are.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.bytes: int | None = None
        self.said = "what tensors held on the device, weights included"
        self._before: int | None = None

    def __enter__(self) -> PeakMemory:
        """Forget earlier peaks, and give back what is held unused: what grows would hide in it."""
        gc.collect()
        _trim()
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
            return self
        self.said = "by how much the process grew"
        try:
            CLEAR.write_text(FORGET_PEAK)
            self._before = _resident("VmRSS")
        except OSError as error:
            self.said = f"not known: on a CPU, Linux alone tells ({error})"
        return self

    def __exit__(self, *_: object) -> None:
        """Read the peak."""
        if self.device.type == "cuda":
            self.bytes = torch.cuda.max_memory_allocated(self.device)
        elif self._before is not None:
            self.bytes = max(0, _resident("VmHWM") - self._before)


def _trim() -> None:
    """Freed memory that the C library kept for later goes back to the system, where glibc is it."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def _resident(field: str) -> int:
    """A line of this process's status, bytes."""
    for line in STATUS.read_text().splitlines():
        name, _, value = line.partition(":")
        if name == field:
            return int(value.split()[0]) * 1024
    raise OSError(f"{STATUS}: no {field}")
