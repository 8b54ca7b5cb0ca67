"""Weights on disk: reading them strictly, writing them whole, saying precisely what does not fit.

A weights folder is one of two: our own (``config.json`` and ``geoverse.safetensors`` with every
tensor), or one of published files as they were downloaded (``published.py``), with or without a
trained extension. A missing, unexpected or misshapen tensor is always an error.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.published import EXTENSION, Part
from gvtools.completers.geoverse.wan_files import TensorFiles
from gvtools.errors import CheckpointError


@dataclass(frozen=True)
class Fit:
    """How stored tensors fit expected ones.

    Attributes:
        expected: how many tensors are asked for.
        missing: names that are asked for and absent.
        unexpected: names that are there and not asked for.
        misshapen: "NAME is (2, 3), expected (3, 2)".
    """

    expected: int
    missing: tuple[str, ...]
    unexpected: tuple[str, ...]
    misshapen: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Everything that is asked for is there, and nothing else."""
        return not (self.missing or self.unexpected or self.misshapen)

    def __str__(self) -> str:
        """One line: what does not fit, the first of each kind by name."""
        if self.ok:
            return f"{self.expected} tensors fit"
        said = []
        for what, names in (
            ("missing", self.missing),
            ("unexpected", self.unexpected),
            ("of another shape", self.misshapen),
        ):
            if names:
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                said.append(f"{what}: {names[0]}{more}")
        return f"of {self.expected} tensors " + "; ".join(said)


Shapes = Mapping[str, tuple[int, ...]]


def fit(stored: Shapes, expected: Shapes) -> Fit:
    """Compare names and shapes."""
    return Fit(
        expected=len(expected),
        missing=tuple(name for name in expected if name not in stored),
        unexpected=tuple(name for name in stored if name not in expected),
        misshapen=tuple(
            f"{name} is {stored[name]}, expected {shape}"
            for name, shape in expected.items()
            if name in stored and stored[name] != shape
        ),
    )


def shapes(tensors: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Name to shape."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


def expected_of(module: nn.Module, part: Part) -> dict[str, tuple[int, ...]]:
    """What a part's file has to hold for a (meta) ``GeoVerse``: its module without extensions."""
    return {
        name.removeprefix(part.module): tuple(tensor.shape)
        for name, tensor in module.state_dict().items()
        if name.startswith(part.module) and not name.startswith(EXTENSION)
    }


def is_extension(name: str) -> bool:
    """Whether a key of ``GeoVerse`` is what GeoVerse adds to published networks."""
    return name.startswith(EXTENSION)


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a .safetensors, .pt or .pth file, mapped from disk, by their stored names.

    Raises:
        CheckpointError: the file is absent, damaged, or holds more than tensors and plain values.
    """
    if path.suffix == ".safetensors":
        files = TensorFiles.find(path)
        return {name: files.read(name) for name in files.files}
    return _flat(_unpickled(path), path)


def read_part(path: Path, part: Part) -> dict[str, Tensor]:
    """A part's tensors by the names of our module.

    Raises:
        CheckpointError: see ``read_tensors``.
    """
    if path.suffix == ".safetensors":
        stored = read_tensors(path)
    else:
        content = _unpickled(path)
        for key in part.nested:
            if isinstance(content.get(key), Mapping):
                content = content[key]
                break
        stored = _flat(content, path)
    found = part.renamed(stored)
    if part.name.startswith("statistics"):
        found = {name: found[name].reshape(-1) for name in ("mean", "var") if name in found}
    return found


def load(module: nn.Module, tensors: Mapping[str, Tensor], *, where: object) -> None:
    """Put tensors into a module, in float32, without copying what is float32 already.

    Args:
        module: may be on the meta device.
        tensors: by the names of its state dict, all of them.
        where: what the message names.

    Raises:
        CheckpointError: a tensor is missing, unexpected or of another shape.
    """
    found = fit(shapes(tensors), shapes(module.state_dict()))
    if not found.ok:
        raise CheckpointError(f"{where}: {found}; the file is of another network or version")
    module.load_state_dict({name: tensor.float() for name, tensor in tensors.items()}, assign=True)


def check_finite(tensors: Mapping[str, Tensor], *, where: object) -> None:
    """Raises CheckpointError on the first tensor that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{where}: {name} holds values that are not finite")


def write_tensors(
    tensors: Iterable[tuple[str, Tensor]], path: Path, *, dtype: torch.dtype, about: str
) -> None:
    """Write a .safetensors file: to a temporary name, then renamed.

    Args:
        tensors: name and tensor.
        path: of the file.
        dtype: what floating-point tensors are stored as.
        about: goes into the file's metadata.
    """
    from safetensors.torch import save_file

    stored = {
        name: tensor.detach()
        .to("cpu", dtype if tensor.is_floating_point() else tensor.dtype)
        # A view of another tensor, or one that shares its storage, cannot be stored as it is.
        .clone(memory_format=torch.contiguous_format)
        for name, tensor in tensors
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    try:
        save_file(stored, str(part), metadata={"format": "pt", "about": about})
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _unpickled(path: Path) -> dict[str, Any]:
    """A .pt file's dictionary; no code in it is run."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except FileNotFoundError:
        raise CheckpointError(f"no {path}; download it, see gvtools weights list") from None
    except (OSError, RuntimeError, pickle.UnpicklingError, ValueError, EOFError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise CheckpointError(
            f"{path}: cannot be read ({reason}); expected a whole PyTorch file of tensors alone; "
            "download it again"
        ) from None
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: holds a {type(content).__name__}; expected a dictionary")
    return content


def _flat(content: Mapping[str, Any], path: Path) -> dict[str, Tensor]:
    """The tensors of a dictionary; scalars beside them are passed over, other objects are not."""
    tensors = {name: value for name, value in content.items() if isinstance(value, Tensor)}
    for name, value in content.items():
        if not isinstance(value, (Tensor, int, float, str, bool, type(None))):
            raise CheckpointError(
                f"{path}: {name!r} is a {type(value).__name__}; expected tensors by name"
            )
    return tensors
