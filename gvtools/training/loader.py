"""Batches of a data set in order, made ahead by other processes, which change nothing in them.

A sample follows from its number, so that there is no state to save.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Generator, Iterable, Iterator
from typing import Any

import numba
import torch
from numpy.typing import NDArray

from gvtools.errors import GvError, ProjectError
from gvtools.training.batch import TrainingBatch
from gvtools.training.dataset import Samples
from gvtools.training.view_sample import TENSORS, Sample, collated

# A sample on its way: its context views and notes, its tensors as arrays; or why there is none.
_Made = tuple[int, tuple[str, ...], dict[str, NDArray[Any]]] | GvError


def batches(
    data: Samples, parts: Iterable[range], *, workers: int
) -> Generator[TrainingBatch, None, None]:
    """Batches of the samples with these numbers; closing the iterator ends the workers.

    Args:
        data: the data set; has to be picklable when there are workers.
        parts: numbers of each batch's samples, without end.
        workers: processes that make samples; 0 makes them when they are asked for.
    """
    if not workers:
        for part in parts:
            yield collated([data.sample(number) for number in part])
        return
    loader: torch.utils.data.DataLoader[list[_Made]] = torch.utils.data.DataLoader(
        _Arrays(data),  # type: ignore[arg-type]
        batch_sampler=parts,  # type: ignore[arg-type]
        num_workers=workers,
        collate_fn=_unchanged,
        worker_init_fn=_begun,
        # Threads of a compiled kernel do not survive a fork.
        multiprocessing_context="spawn",
        # Torch would otherwise draw a number from its global generator.
        generator=torch.Generator(),
    )
    stream = iter(loader)
    while (items := _next(stream)) is not None:
        yield collated([_restored(item) for item in items])


def _next(stream: Iterator[list[_Made]]) -> list[_Made] | None:
    """The samples of the next batch."""
    try:
        return next(stream, None)
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise ProjectError(
            f"a process that makes samples has died ({str(error).splitlines()[0]}); where memory "
            "ran out, lower data.workers; go on with --resume"
        ) from error


class _Arrays:
    """A data set's samples as arrays.

    Arrays travel through a pipe; tensors would take shared memory, of which containers have little.
    """

    def __init__(self, data: Samples) -> None:
        self.data = data

    def __getitem__(self, number: int) -> _Made:
        try:
            sample = self.data.sample(number)
        except GvError as error:
            # Raised in this process it would reach the user as a traceback.
            return error
        arrays = {name: getattr(sample, name).numpy() for name in TENSORS}
        return sample.context, sample.notes, arrays


def _restored(made: _Made) -> Sample:
    if isinstance(made, GvError):
        raise made
    context, notes, values = made
    tensors: dict[str, Any] = {name: torch.from_numpy(value) for name, value in values.items()}
    return Sample(**tensors, context=context, notes=notes)


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
