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
        if self.folder is None:
            return _dequantise(_quantise(self.data.sample(number)))
        path = self._place / f"{number:06d}.npz"
        packed = _read(path) if path.exists() else None
        if packed is None:
            packed = _quantise(self.data.sample(number))
            # Without compression: reading is to cost nothing.
            with replaced_when_written(path) as temporary, temporary.open("wb") as file:
                np.savez(file, **packed)  # type: ignore[arg-type]
        return _dequantise(packed)

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        return {"pool": self.count, **self.data.describe()}

    @property
    def _place(self) -> Path:
        text = json.dumps(self.data.describe(), sort_keys=True, default=str)
        assert self.folder is not None
        return self.folder / hashlib.sha256(text.encode() + _code()).hexdigest()[:16]


@cache
def _code() -> bytes:
    """Digest of the library's code, by which samples are made."""
    digest = hashlib.sha256()
    for file in sorted(Path(gvtools.__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.digest()


def _quantise(sample: TrainingSample) -> dict[str, NDArray[Any]]:
    packed: dict[str, NDArray[Any]] = {
        "context": np.array(sample.context),
        "notes": np.array(sample.notes, str),
    }
    for name in TENSORS:
        values = getattr(sample, name).numpy()
        if name in COLORS:
            values = np.rint(values * 255).astype(np.uint8)
        elif name in DEPTHS:
            values = np.clip(values, 0, GREATEST).astype(np.float16)
        packed[name] = values
    return packed


def _dequantise(packed: dict[str, NDArray[Any]]) -> TrainingSample:
    tensors: dict[str, Any] = {}
    for name in TENSORS:
        values = packed[name]
        if name in COLORS:
            tensors[name] = torch.from_numpy(values).float() / 255
        elif name in DEPTHS:
            tensors[name] = torch.from_numpy(values.astype(np.float32))
        else:
            tensors[name] = torch.from_numpy(values)
    notes = tuple(packed["notes"].tolist())
    return TrainingSample(**tensors, context=int(packed["context"]), notes=notes)


def _read(path: Path) -> dict[str, NDArray[Any]] | None:
    """None where the file is damaged: it is made again."""
    try:
        return load_arrays(path)
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        return None


# A sample on its way to the training, or why there is none.
_Parcel = tuple[int, tuple[str, ...], dict[str, NDArray[Any]]] | GvError


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
    loader: torch.utils.data.DataLoader[list[_Parcel]] = torch.utils.data.DataLoader(
        _Arrays(data),  # type: ignore[arg-type]
        batch_sampler=parts,  # type: ignore[arg-type]
        num_workers=workers,
        collate_fn=_identity,
        worker_init_fn=_start_worker,
        # Threads of a compiled kernel do not survive a fork.
        multiprocessing_context="spawn",
        # Torch would otherwise draw a number from its global generator.
        generator=torch.Generator(),
    )
    stream = iter(loader)
    while (parcels := _next(stream)) is not None:
        yield collate([_unpack(parcel) for parcel in parcels])


def _next(stream: Iterator[list[_Parcel]]) -> list[_Parcel] | None:
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

    def __getitem__(self, number: int) -> _Parcel:
        try:
            sample = self.data.sample(number)
        except GvError as error:
            # Raised in this process it would reach the user as a traceback.
            return error
        arrays = {name: getattr(sample, name).numpy() for name in TENSORS}
        return sample.context, sample.notes, arrays


def _unpack(parcel: _Parcel) -> TrainingSample:
    if isinstance(parcel, GvError):
        raise parcel
    context, notes, arrays = parcel
    tensors: dict[str, Any] = {name: torch.from_numpy(value) for name, value in arrays.items()}
    return TrainingSample(**tensors, context=context, notes=notes)


def _identity(item: Any) -> Any:
    return item


def _start_worker(worker: int) -> None:
    numba.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for ever to hand its sample over."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(0)
