"""Loading of samples: worker processes, and a pool of samples on disk.

A sample follows from its number, so that there is no state to save. A pool is a limited number of
samples that are seen again and again, since rendering takes a third of a small training's time;
colours are kept with 8 bits and depths as float16, whether a sample comes from the disk or was just
made, so that the files decide nothing.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import threading
import zipfile
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray

import gvtools
from gvtools.errors import GvError, ProjectError
from gvtools.files import replaced_when_written
from gvtools.training.samples import TENSORS, TrainingBatch, TrainingSample, collate
from gvtools.training.views import Samples
from gvtools.untrusted import load_arrays

Arrays = dict[str, NDArray[Any]]
# A sample on its way to the training, or why there is none.
Parcel = Arrays | GvError

COLORS, DEPTHS = ("images", "hint"), ("depth", "hint_depth", "evidence")
GREATEST = float(np.finfo(np.float16).max)


@dataclass(frozen=True)
class PooledViews:
    """The first ``count`` samples of a data set, over and over."""

    data: Samples
    count: int  # a multiple of the data set's group, so that a batch stays within one
    # where they are kept, in a folder of their own named after what decides them, the code
    # included; None makes them anew each time
    folder: Path | None = None

    def sample(self, index: int) -> TrainingSample:
        """The sample of a number; numbers ``count`` apart have the same."""
        number = index % self.count
        path = None if self.folder is None else self._place(self.folder) / f"{number:06d}.npz"
        packed = None if path is None or not path.exists() else _read(path)
        if packed is None:
            packed = _quantise(_arrays(self.data.sample(number)))
            if path is not None:
                # Without compression: reading is to cost nothing.
                with replaced_when_written(path) as temporary, temporary.open("wb") as file:
                    np.savez(file, **packed)  # type: ignore[arg-type]
        return _sample(_dequantise(packed))

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        return {"pool": self.count, **self.data.describe()}

    def _place(self, folder: Path) -> Path:
        text = json.dumps(self.data.describe(), sort_keys=True, default=str)
        return folder / hashlib.sha256(text.encode() + _code()).hexdigest()[:16]


@cache
def _code() -> bytes:
    """Digest of the library's code, by which samples are made."""
    digest = hashlib.sha256()
    for file in sorted(Path(gvtools.__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.digest()


def _arrays(sample: TrainingSample) -> Arrays:
    tensors = {name: getattr(sample, name).numpy() for name in TENSORS}
    return {"context": np.array(sample.context), "notes": np.array(sample.notes, str), **tensors}


def _sample(arrays: Arrays) -> TrainingSample:
    tensors: dict[str, Any] = {name: torch.from_numpy(arrays[name]) for name in TENSORS}
    notes = tuple(arrays["notes"].tolist())
    return TrainingSample(**tensors, context=int(arrays["context"]), notes=notes)


def _quantise(arrays: Arrays) -> Arrays:
    colors = {name: np.rint(arrays[name] * 255).astype(np.uint8) for name in COLORS}
    depths = {name: np.clip(arrays[name], 0, GREATEST).astype(np.float16) for name in DEPTHS}
    return {**arrays, **colors, **depths}


def _dequantise(arrays: Arrays) -> Arrays:
    colors = {name: arrays[name].astype(np.float32) / np.float32(255) for name in COLORS}
    return {**arrays, **colors, **{name: arrays[name].astype(np.float32) for name in DEPTHS}}


def _read(path: Path) -> Arrays | None:
    """None where the file is damaged: it is made again."""
    try:
        return load_arrays(path)
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        return None


def batches(
    data: Samples, parts: Iterable[range], *, workers: int
) -> Generator[TrainingBatch, None, None]:
    """Batches of the samples with these numbers; closing the iterator ends the workers.

    With ``workers``, ``data`` has to be picklable; 0 makes samples when they are asked for.
    """
    if not workers:
        for part in parts:
            yield collate([data.sample(number) for number in part])
        return
    loader: torch.utils.data.DataLoader[list[Parcel]] = torch.utils.data.DataLoader(
        _ArraySamples(data),  # type: ignore[arg-type]
        batch_sampler=parts,  # type: ignore[arg-type]
        num_workers=workers,
        collate_fn=list,
        worker_init_fn=_start_worker,
        # Threads of a compiled kernel do not survive a fork.
        multiprocessing_context="spawn",
        # Torch would otherwise draw a number from its global generator.
        generator=torch.Generator(),
    )
    stream = iter(loader)
    while (parcels := _next(stream)) is not None:
        samples = []
        for parcel in parcels:
            if isinstance(parcel, GvError):
                raise parcel
            samples.append(_sample(parcel))
        yield collate(samples)


def _next(stream: Iterator[list[Parcel]]) -> list[Parcel] | None:
    try:
        return next(stream, None)
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise ProjectError(
            f"a process that makes samples has died ({str(error).splitlines()[0]}); where memory "
            "ran out, lower data.workers; go on with --resume"
        ) from error


class _ArraySamples:
    """A data set's samples as arrays.

    Arrays travel through a pipe; tensors would take shared memory, of which containers have little.
    """

    def __init__(self, data: Samples) -> None:
        self.data = data

    def __getitem__(self, number: int) -> Parcel:
        try:
            return _arrays(self.data.sample(number))
        except GvError as error:
            # Raised in this process it would reach the user as a traceback.
            return error


def _start_worker(worker: int) -> None:
    numba.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for ever to hand its sample over."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(0)
