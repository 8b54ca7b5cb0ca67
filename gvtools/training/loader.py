"""Batches of a data set, made ahead by other processes; what they hold does not depend on those.

A sample follows from its number, so that a loader has no state to save.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any

import numba
import torch
from numpy.typing import NDArray

from gvtools.errors import GvError
from gvtools.training.batch import TrainingBatch
from gvtools.training.dataset import Samples
from gvtools.training.view_sample import Sample, collated

STEPS_AHEAD = 2
# A sample on its way: its number, its context views, its tensors as arrays; or why there is none.
_Made = tuple[int, int, dict[str, NDArray[Any]] | GvError]


class BatchLoader:
    """Batches by the numbers of their samples.

    Samples are made ahead in the order of steps of ``batch`` samples, of which this process takes
    its ``share``; any other order gives the same batches, but nothing is ready then.

    Args:
        data: the data set; has to be picklable when there are workers.
        batch: samples a step, over all processes.
        workers: processes that make samples; 0 makes them when they are asked for.
        share: of a step's numbers, those of this process; None for all.
    """

    def __init__(
        self,
        data: Samples,
        batch: int,
        *,
        workers: int = 0,
        share: Callable[[range], range] | None = None,
    ) -> None:
        self.data, self.batch, self.workers, self.share = data, batch, workers, share
        self._stream: Iterator[_Made] | None = None
        self._expected = -1

    def __call__(self, numbers: range) -> TrainingBatch:
        """The batch of some samples.

        Raises:
            ShapeError: their numbers of context views differ.
        """
        return collated([self._take(number) for number in numbers])

    def close(self) -> None:
        """End the workers."""
        self._stream = None

    def _take(self, number: int) -> Sample:
        if not self.workers:
            return self.data.sample(number)
        if self._stream is None or self._expected != number:
            self._stream = iter(self._loader(number))
        made, context, values = next(self._stream)
        if isinstance(values, GvError):
            raise values
        if made != number:
            # Outside this process's share nothing is made ahead.
            self._expected = -1
            return self.data.sample(number)
        self._expected = next(iter(_Order(self, number + 1)))
        tensors: dict[str, Any] = {name: torch.from_numpy(value) for name, value in values.items()}
        return Sample(**tensors, context=context)

    def _loader(self, start: int) -> torch.utils.data.DataLoader:
        return torch.utils.data.DataLoader(
            _Numbered(self.data),  # type: ignore[arg-type]
            batch_size=None,
            sampler=_Order(self, start),  # type: ignore[arg-type]
            num_workers=self.workers,
            collate_fn=_unchanged,
            worker_init_fn=_begun,
            prefetch_factor=max(2, -(-STEPS_AHEAD * self.batch // self.workers)),
            # Threads of a compiled kernel do not survive a fork.
            multiprocessing_context="spawn",
            # Torch would otherwise draw a number from its global generator.
            generator=torch.Generator(),
        )


class _Order:
    """The numbers that a loader's process takes, from one of them on."""

    def __init__(self, loader: BatchLoader, start: int) -> None:
        self.loader, self.start = loader, start

    def __iter__(self) -> Iterator[int]:
        batch, share = self.loader.batch, self.loader.share
        step = self.start // batch
        while True:
            whole = range(step * batch, (step + 1) * batch)
            yield from (n for n in (share(whole) if share else whole) if n >= self.start)
            step += 1


class _Numbered:
    """A data set's samples as arrays, with their numbers.

    Arrays travel through a pipe; tensors would take shared memory, of which containers have little.
    """

    def __init__(self, data: Samples) -> None:
        self.data = data

    def __getitem__(self, number: int) -> _Made:
        try:
            sample = self.data.sample(number)
        except GvError as error:
            # Raised in this process it would reach the user as a traceback.
            return number, 0, error
        names = [entry.name for entry in fields(Sample) if entry.name != "context"]
        return number, sample.context, {name: getattr(sample, name).numpy() for name in names}


def _unchanged(item: Any) -> Any:
    return item


def _begun(worker: int) -> None:
    numba.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for ever to hand its sample over."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(0)
