"""Tensors of weights files: read strictly, compared precisely, loaded whole or not at all.

A missing, unexpected or misshapen tensor is always an error, and so is one that holds no finite
floating-point numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.weights.pickled_tensors import (
    check_not_placeholder,
    first_line,
    read_pickled,
)
from gvtools.completers.geoverse.weights.published import EXTENSION, Part
from gvtools.errors import CheckpointError

Shapes = Mapping[str, tuple[int, ...]]

# What is loaded, as float32; quantised numbers mean nothing without their scales.
READABLE = (torch.float32, torch.float16, torch.bfloat16, torch.float64)


# Bytes to a multiple of which torch allocates.
_ALIGNMENT = 64


@dataclass(frozen=True)
class Fit:
    """How stored tensors fit expected ones.

    Attributes:
        expected: how many tensors are asked for.
        missing: names that are asked for and absent.
        unexpected: names that are there and not asked for.
        misshapen: "NAME is (2, 3), expected (3, 2)".
        mistyped: "NAME is int64, expected float32, float16, ...".
    """

    expected: int
    missing: tuple[str, ...]
    unexpected: tuple[str, ...]
    misshapen: tuple[str, ...]
    mistyped: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Everything that is asked for is there, and nothing else."""
        return not (self.missing or self.unexpected or self.misshapen or self.mistyped)

    def __str__(self) -> str:
        """One line: what does not fit, the first of each kind by name."""
        if self.ok:
            return f"{self.expected} tensors fit"
        said = []
        for what, names in (
            ("missing", self.missing),
            ("unexpected", self.unexpected),
            ("of another shape", self.misshapen),
            ("of another type", self.mistyped),
        ):
            if names:
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                said.append(f"{what}: {names[0]}{more}")
        return f"of {self.expected} tensors " + "; ".join(said)


def fit(stored: Mapping[str, Tensor], expected: Shapes) -> Fit:
    """Compare names, shapes and types."""
    found = shapes(stored)
    return Fit(
        expected=len(expected),
        missing=tuple(name for name in expected if name not in found),
        unexpected=tuple(name for name in found if name not in expected),
        misshapen=tuple(
            f"{name} is {found[name]}, expected {shape}"
            for name, shape in expected.items()
            if name in found and found[name] != shape
        ),
        mistyped=tuple(
            f"{name} is {kind}, expected float32, float16, bfloat16 or float64"
            for name, kind in ((name, _kind(stored[name])) for name in expected if name in found)
            if kind
        ),
    )


def _kind(tensor: Tensor) -> str:
    """What a tensor is that cannot be loaded; empty for one that can."""
    if tensor.is_sparse or tensor.layout != torch.strided:
        return "sparse"
    if tensor.is_quantized or tensor.dtype not in READABLE:
        return str(tensor.dtype).removeprefix("torch.")
    return ""


def shapes(tensors: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Name to shape."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


def expected_of(module: nn.Module, part: Part) -> dict[str, tuple[int, ...]]:
    """What a part's file has to hold for a (meta) ``GeoVerse``: its module without extensions."""
    return {
        name.removeprefix(part.module): tuple(tensor.shape)
        for name, tensor in module.state_dict().items()
        if name.startswith(part.module) and not is_extension(name)
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
        return _read_safetensors(path)[0]
    return _flat(read_pickled(path), path)


def read_about(path: Path) -> str:
    """What ``save_tensors`` was told about a .safetensors file; empty for others' files."""
    return _read_safetensors(path)[1].get("about", "")


@dataclass(frozen=True)
class Stored:
    """What a file holds for a part.

    Attributes:
        tensors: by the names of our module, without its prefix.
        passed_over: names in the file that belong to other networks or are no weights.
    """

    tensors: dict[str, Tensor]
    passed_over: tuple[str, ...] = ()


def read_part(path: Path, part: Part) -> dict[str, Tensor]:
    """A part's tensors by the names of our module; see ``read_stored``."""
    return read_stored(path, part).tensors


def read_stored(path: Path, part: Part) -> Stored:
    """A part's tensors by the names of our module, and what else its file holds.

    Raises:
        CheckpointError: see ``read_tensors``; or two stored tensors claim one name.
    """
    if path.suffix == ".safetensors":
        stored = read_tensors(path)
    else:
        content = read_pickled(path)
        inner = next((k for k in part.nested if isinstance(content.get(k), Mapping)), None)
        stored = _flat(content if inner is None else content[inner], path)
        if part.name.startswith("statistics"):
            return _statistics(content, stored, path, part)
    found: dict[str, Tensor] = {}
    passed = []
    for key, tensor in stored.items():
        name = part.own_name(key)
        if name is None:
            passed.append(key)
        elif name in found:
            raise CheckpointError(f"{path}: holds {name} twice, also as {key}; expected it once")
        else:
            found[name] = tensor
    _share(found, part, path)
    return Stored(found, tuple(passed))


def _share(found: dict[str, Tensor], part: Part, path: Path) -> None:
    """Give tied names their common tensor where the file has it under some of them."""
    for names in part.tied:
        there = [name for name in names if name in found]
        if not there or len(there) == len(names):
            continue
        first = found[there[0]]
        for name in there[1:]:
            if not torch.equal(found[name], first):
                raise CheckpointError(
                    f"{path}: {name} differs from {there[0]}; expected one tensor of all of "
                    f"{names[0]} to {names[-1]}, or every one of them"
                )
        found |= dict.fromkeys(names, first)


def _statistics(
    content: Mapping[str, object], stored: dict[str, Tensor], path: Path, part: Part
) -> Stored:
    """Mean and variance of a level, (C,); that level is checked where the file names one."""
    expected = int(part.name.removeprefix("statistics"))
    level = content.get("level")
    # Of the four levels the last may be called -1.
    if isinstance(level, int) and -4 <= level < 4 and level % 4 != expected:
        raise CheckpointError(f"{path}: statistics of level {level}; expected level {expected}")
    known: tuple[str, ...] = ("mean", "var")
    found = {name: stored[name].reshape(-1) for name in known if name in stored}
    if "var" in found and bool((found["var"] < 0).any()):
        raise CheckpointError(f"{path}: var is negative in places; expected variances")
    return Stored(found, tuple(name for name in stored if name not in found))


def load(
    module: nn.Module,
    tensors: Mapping[str, Tensor],
    *,
    where: object,
    device: torch.device | str = "cpu",
) -> None:
    """Put tensors into a module, in float32; what is so already may stay mapped from its file.

    Args:
        module: may be on the meta device.
        tensors: by the names of its state dict, all of them.
        where: what the message names.
        device: of the module afterwards.

    Raises:
        CheckpointError: a tensor is missing, unexpected, of another shape, or not of numbers.
    """
    found = fit(tensors, shapes(module.state_dict()))
    if not found.ok:
        raise CheckpointError(f"{where}: {found}; the file is of another network or version")
    module.load_state_dict(
        {name: _placed(tensor, device) for name, tensor in tensors.items()}, assign=True
    )


def _placed(tensor: Tensor, device: torch.device | str) -> Tensor:
    """Contiguous float32 on a device, where torch would have put it."""
    placed = tensor.to(device, torch.float32).contiguous()
    # Products depend on the alignment in their last bit, and that of a file's tensors is by chance.
    return placed.clone() if placed.data_ptr() % _ALIGNMENT else placed


def check_finite(tensors: Mapping[str, Tensor], *, where: object) -> None:
    """Raises CheckpointError on the first tensor that holds a NaN or an infinity."""
    name = not_finite(tensors)
    if name is not None:
        raise CheckpointError(f"{where}: {name} holds values that are not finite")


def not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """The first tensor of floating-point numbers that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        # Both ends are NaN where any number is; one pass, and nothing of the tensor's size is made.
        if tensor.numel() and tensor.is_floating_point():
            ends = torch.stack(torch.aminmax(tensor.detach()))
            if not bool(torch.isfinite(ends).all()):
                return name
    return None


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors, mapped from disk, and the metadata."""
    from safetensors import safe_open

    check_not_placeholder(path)
    try:
        with safe_open(str(path), framework="pt") as file:
            names = list(file.keys())
            return {name: file.get_tensor(name) for name in names}, file.metadata() or {}
    except Exception as error:
        raise CheckpointError(
            f"{path}: cannot be read ({first_line(error)}); expected a whole safetensors file; "
            "download it again"
        ) from None


def _flat(content: Mapping[Any, Any], path: Path) -> dict[str, Tensor]:
    """The tensors of a dictionary; scalars beside them are passed over, other objects are not."""
    tensors = {}
    for name, value in content.items():
        if not isinstance(name, str) or not isinstance(
            value, (Tensor, int, float, str, bool, type(None))
        ):
            raise CheckpointError(
                f"{path}: {name!r} is a {type(value).__name__}; expected tensors by name"
            )
        if isinstance(value, Tensor):
            tensors[name] = value
    return tensors
