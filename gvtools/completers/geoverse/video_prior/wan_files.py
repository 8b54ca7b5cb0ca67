"""Tensors in safetensors files, found by name and read one by one.

The library maps a whole file copy-on-write, which Linux refuses where the file is larger than the
machine's memory, as a published video model is. Here a tensor's own bytes are read.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gvtools.errors import CheckpointError

INDEX = ".safetensors.index.json"
_PLAIN = {"F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}
_DTYPES = {
    **_PLAIN,
    "F64": torch.float64,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}
# The format's own limit of a header, bytes.
_LARGEST_HEADER = 100_000_000


class TensorFiles:
    """The tensors of one network, in one file or in several with an index.

    Only headers are read until ``read`` is called, and a file in which no tensor is asked for is
    not opened: it need not even be there.

    Args:
        files: the file of each tensor, by the tensor's name.
    """

    def __init__(self, files: Mapping[str, Path]) -> None:
        self.files = dict(files)
        self._known: dict[Path, _File] = {}

    @classmethod
    def find(cls, place: Path) -> TensorFiles:
        """Of a safetensors file, or of the one network in a folder.

        Raises:
            CheckpointError: there is none, or more than one, or it is damaged.
        """
        if place.is_file():
            return cls(dict.fromkeys(_File(place).header, place))
        for pattern in (f"*{INDEX}", "*.safetensors"):
            found = sorted(place.glob(pattern))
            if len(found) > 1:
                raise CheckpointError(
                    f"{place}: {len(found)} times {pattern} ({found[0].name}, {found[1].name}, "
                    "...); expected one network, or name its file"
                )
            if found and pattern == f"*{INDEX}":
                return cls({n: place / file for n, file in _read_index(found[0]).items()})
            if found:
                return cls.find(found[0])
        raise CheckpointError(f"{place}: no *.safetensors; expected a network's weights there")

    def shape(self, name: str) -> tuple[int, ...]:
        """Of one tensor; KeyError where there is none of that name."""
        return self._file(name).header[name].shape

    def read(self, name: str, *, device: str = "cpu") -> Tensor:
        """One tensor, as stored.

        Raises:
            CheckpointError: the file is damaged, or the tensor of a type that torch has not.
        """
        return self._file(name).read(name).to(device)

    def numbers(self, name: str) -> int:
        """How many numbers a tensor holds.

        Raises:
            CheckpointError: it is quantised: its numbers mean nothing without their scales.
        """
        kind = self._file(name).header[name].kind
        if kind not in _PLAIN:
            raise CheckpointError(
                f"{self.files[name]}: {name} is stored as {kind}; expected one of "
                f"{', '.join(_PLAIN)}; take the weights that were published without quantisation"
            )
        return prod(self.shape(name))

    def _file(self, name: str) -> _File:
        path = self.files[name]
        file = self._known.setdefault(path, _File(path))
        if name not in file.header:
            raise CheckpointError(f"{path}: no {name}, which its index puts there")
        return file


@dataclass(frozen=True)
class _Entry:
    kind: str
    shape: tuple[int, ...]
    start: int
    end: int


@dataclass(frozen=True)
class _File:
    """One safetensors file: the header's length, the header in JSON, the tensors' bytes."""

    path: Path

    @cached_property
    def header(self) -> dict[str, _Entry]:
        """Where each tensor is, in bytes of the file."""
        try:
            with self.path.open("rb") as file:
                length = int.from_bytes(file.read(8), "little")
                if length > _LARGEST_HEADER:
                    raise ValueError("no header")
                stored = json.loads(file.read(length))
            stored.pop("__metadata__", None)
            header = {name: _entry(value, 8 + length) for name, value in stored.items()}
            size = self.path.stat().st_size
            if max((entry.end for entry in header.values()), default=8 + length) != size:
                raise ValueError(f"{size} bytes, which is not what its header says")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise CheckpointError(
                f"{self.path}: cannot be read ({getattr(error, 'strerror', None) or error}); "
                "expected a whole safetensors file; download it again"
            ) from error
        return header

    def read(self, name: str) -> Tensor:
        entry = self.header[name]
        dtype = _DTYPES.get(entry.kind)
        if dtype is None or entry.end - entry.start != prod(entry.shape) * dtype.itemsize:
            raise CheckpointError(
                f"{self.path}: {name} is {entry.kind} {entry.shape} in "
                f"{entry.end - entry.start} bytes, which cannot be read"
            )
        content = torch.empty(entry.end - entry.start, dtype=torch.uint8)
        with self.path.open("rb") as file:
            file.seek(entry.start)
            if file.readinto(memoryview(content.numpy())) != len(content):  # type: ignore[arg-type]
                raise CheckpointError(f"{self.path}: ends within {name}; download it again")
        return content.view(dtype).reshape(entry.shape)


def _entry(value: Any, data: int) -> _Entry:
    start, end = value["data_offsets"]
    shape = tuple(int(n) for n in value["shape"])
    if not 0 <= start <= end or any(n < 0 for n in shape):
        raise ValueError("a tensor without a place")
    return _Entry(str(value["dtype"]), shape, data + start, data + end)


def check_tensors(
    files: TensorFiles, expected: Mapping[str, tuple[int, ...]], *, where: object
) -> None:
    """Names and shapes of a network's tensors, by headers alone.

    Raises:
        CheckpointError: the first tensor that is absent, of another shape, or not of the network.
    """
    check_present(expected, files.files, where=where)
    for name, shape in expected.items():
        if files.shape(name) != shape:
            raise CheckpointError(
                f"{where}: {name} is {files.shape(name)}; expected {shape} by its config.json"
            )
    for name in files.files:
        if name not in expected:
            raise CheckpointError(
                f"{where}: {name} is no tensor of the network in its config.json; make the "
                "folder anew"
            )


def check_present(expected: Iterable[str], found: Iterable[str], *, where: object) -> None:
    """Every expected name is found.

    Raises:
        CheckpointError: names the first that is not, and how many there are.
    """
    known = set(found)
    absent = [name for name in expected if name not in known]
    if absent:
        raise CheckpointError(
            f"{where}: {absent[0]} is absent"
            + (f", and {len(absent) - 1} more" if len(absent) > 1 else "")
            + f", among {len(known)} tensors; expected every tensor of the network; the download "
            "is not whole, or of another network"
        )


def _read_index(path: Path) -> dict[str, str]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["weight_map"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error}); expected an index of safetensors files"
        ) from error
