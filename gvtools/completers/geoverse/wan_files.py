"""Tensors in safetensors files, found by name and read one by one."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from math import prod
from pathlib import Path
from typing import Any

from torch import Tensor

from gvtools.errors import CheckpointError

INDEX = ".safetensors.index.json"
_BYTES = {"F32": 4, "F16": 2, "BF16": 2}


class TensorFiles:
    """The tensors of one network, in one file or in several with an index.

    Only headers are read until ``read`` is called, and a file in which no tensor is asked for is
    not opened: it need not even be there.

    Args:
        files: the file of each tensor, by the tensor's name.
    """

    def __init__(self, files: Mapping[str, Path]) -> None:
        self.files = dict(files)
        self._open: dict[Path, Any] = {}

    @classmethod
    def find(cls, place: Path) -> TensorFiles:
        """Of a safetensors file, or of the one network in a folder.

        Raises:
            CheckpointError: there is none, or more than one, or it is damaged.
        """
        if place.is_file():
            return cls(dict.fromkeys(_open(place).keys(), place))
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
        return tuple(self._slice(name).get_shape())

    def read(self, name: str, *, device: str = "cpu") -> Tensor:
        """One tensor, as stored."""
        tensor: Tensor = self._file(name).get_tensor(name)
        return tensor.to(device)

    def numbers(self, name: str) -> int:
        """How many numbers a tensor holds.

        Raises:
            CheckpointError: it is quantised: its numbers mean nothing without their scales.
        """
        kind = self._slice(name).get_dtype()
        if kind not in _BYTES:
            raise CheckpointError(
                f"{self.files[name]}: {name} is stored as {kind}; expected one of "
                f"{', '.join(_BYTES)}; take the weights that were published without quantisation"
            )
        return prod(self.shape(name))

    def close(self) -> None:
        """Forget the open files."""
        self._open.clear()

    def _slice(self, name: str) -> Any:
        return self._file(name).get_slice(name)

    def _file(self, name: str) -> Any:
        path = self.files[name]
        if path not in self._open:
            self._open[path] = _open(path)
        return self._open[path]


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


def _open(path: Path) -> Any:
    from safetensors import safe_open

    try:
        return safe_open(str(path), framework="pt")
    except Exception as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error}); expected a whole safetensors file; download it "
            "again"
        ) from error


def _read_index(path: Path) -> dict[str, str]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["weight_map"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error}); expected an index of safetensors files"
        ) from error
