"""A limited number of samples, seen again and again, kept on disk once they were made.

Rendering takes a third of a small training's time. Colours are kept with 8 bits and depths as
float16, whether a sample comes from the disk or was just made, so that the files decide nothing.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import gvtools
from gvtools.errors import OptionError
from gvtools.files import replaced_when_written
from gvtools.training.dataset import Samples
from gvtools.training.view_sample import TENSORS, Sample
from gvtools.untrusted import load_arrays

COLORS, DEPTHS = ("images", "hint"), ("depth", "hint_depth", "evidence")
GREATEST = float(np.finfo(np.float16).max)


@dataclass(frozen=True)
class PooledViews:
    """The first ``count`` samples of a data set, over and over.

    Attributes:
        data: the samples.
        count: a multiple of the data set's group, so that a batch stays within one.
        folder: where they are kept, in a folder of their own named after what decides them, the
            code included; None makes them anew each time.
    """

    data: Samples
    count: int
    folder: Path | None = None

    def __post_init__(self) -> None:
        if self.count % 8:
            raise OptionError(
                f"data.pool = {self.count}; expected a multiple of 8, such as "
                f"{-(-self.count // 8) * 8}"
            )

    def sample(self, index: int) -> Sample:
        """The sample of a number, 0 or more; numbers ``count`` apart have the same."""
        number = index % self.count
        if self.folder is None:
            return _sample(_packed(self.data.sample(number)))
        path = self._place / f"{number:06d}.npz"
        packed = _read(path) if path.exists() else None
        if packed is None:
            packed = _packed(self.data.sample(number))
            # Without compression: reading is to cost nothing.
            with replaced_when_written(path) as temporary, temporary.open("wb") as file:
                np.savez(file, **packed)  # type: ignore[arg-type]
        return _sample(packed)

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


def _packed(sample: Sample) -> dict[str, NDArray[Any]]:
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


def _sample(packed: dict[str, NDArray[Any]]) -> Sample:
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
    return Sample(**tensors, context=int(packed["context"]), notes=notes)


def _read(path: Path) -> dict[str, NDArray[Any]] | None:
    """What a file holds; None where it is damaged, and then it is made again."""
    try:
        return load_arrays(path)
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        return None
