"""Tensors of a network: compared by name, shape and type, loaded into it, saved.

A missing, unexpected or wrongly shaped tensor is always an error, and so is one that holds no
finite floating-point numbers.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from gvtools.errors import CheckpointError

Shapes = Mapping[str, tuple[int, ...]]

# What is loaded, as float32; quantised numbers mean nothing without their scales.
READABLE = (torch.float32, torch.float16, torch.bfloat16, torch.float64)
# What is written.
DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}

# Bytes to a multiple of which torch allocates.
_ALIGNMENT = 64


@dataclass(frozen=True)
class Fit:
    """How stored tensors fit expected ones.

    Attributes:
        expected: how many tensors are asked for.
        missing: names that are asked for and absent.
        unexpected: names that are there and not asked for.
        shape_mismatch: "NAME is (2, 3), expected (3, 2)".
        dtype_mismatch: "NAME is int64, expected float32, float16, ...".
    """

    expected: int
    missing: tuple[str, ...]
    unexpected: tuple[str, ...]
    shape_mismatch: tuple[str, ...]
    dtype_mismatch: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Everything that is asked for is there, and nothing else."""
        return not (self.missing or self.unexpected or self.shape_mismatch or self.dtype_mismatch)

    def __str__(self) -> str:
        """One line: what does not fit, the first of each kind by name."""
        if self.ok:
            return f"{self.expected} tensors fit"
        problems = []
        for what, names in (
            ("missing", self.missing),
            ("unexpected", self.unexpected),
            ("of another shape", self.shape_mismatch),
            ("of another type", self.dtype_mismatch),
        ):
            if names:
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                problems.append(f"{what}: {names[0]}{more}")
        return f"of {self.expected} tensors " + "; ".join(problems)


def fit(stored: Mapping[str, Tensor], expected: Shapes) -> Fit:
    """Compare names, shapes and types."""
    found = shapes(stored)
    return Fit(
        expected=len(expected),
        missing=tuple(name for name in expected if name not in found),
        unexpected=tuple(name for name in found if name not in expected),
        shape_mismatch=tuple(
            f"{name} is {found[name]}, expected {shape}"
            for name, shape in expected.items()
            if name in found and found[name] != shape
        ),
        dtype_mismatch=tuple(
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


def check_fit(stored: Mapping[str, Tensor], expected: Shapes, *, where: object) -> None:
    """Refuse tensors that are not the expected ones, by name, shape and type.

    Args:
        stored: what is there; may be on the meta device.
        expected: name to shape.
        where: what the message names.
    """
    found = fit(stored, expected)
    if not found.ok:
        raise CheckpointError(f"{where}: {found}; the file is of another network or version")


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
    """
    check_fit(tensors, shapes(module.state_dict()), where=where)
    module.load_state_dict(
        {name: _placed(tensor, device) for name, tensor in tensors.items()}, assign=True
    )


def _placed(tensor: Tensor, device: torch.device | str) -> Tensor:
    """Contiguous float32 on a device, where torch would have put it."""
    placed = tensor.to(device, torch.float32).contiguous()
    # Products depend on the alignment in their last bit, and that of a file's tensors is by chance.
    return placed.clone() if placed.data_ptr() % _ALIGNMENT else placed


def not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """The first tensor of floating-point numbers that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        # Both ends are NaN where any number is; one pass, and nothing of the tensor's size is made.
        if tensor.numel() and tensor.is_floating_point():
            ends = torch.stack(torch.aminmax(tensor.detach()))
            if not bool(torch.isfinite(ends).all()):
                return name
    return None


def share_tied(
    tensors: dict[str, Tensor], tied: tuple[tuple[str, ...], ...], *, where: object
) -> None:
    """Give tied names their common tensor where a file has it under some of them, in place.

    Args:
        tensors: by name; may be on the meta device.
        tied: groups of names that are one tensor in the publisher's network.
        where: what the message names.
    """
    for names in tied:
        present = [name for name in names if name in tensors]
        if not present or len(present) == len(names):
            continue
        first = tensors[present[0]]
        for name in present[1:]:
            if not first.is_meta and not torch.equal(tensors[name], first):
                raise CheckpointError(
                    f"{where}: {name} differs from {present[0]}; expected one tensor of all of "
                    f"{names[0]} to {names[-1]}, or every one of them"
                )
        tensors |= dict.fromkeys(names, first)


def save_tensors(
    tensors: Mapping[str, Tensor],
    file: Path,
    *,
    dtype: str = "float32",
    exact: Collection[str] = (),
    about: str,
) -> None:
    """Write a .safetensors file under the name it is given, flushed to the disk.

    Args:
        tensors: by name.
        file: to be written.
        dtype: what floating-point tensors are stored as, one of ``DTYPES``.
        exact: names that keep float32, because rounding them matters.
        about: goes into the file's metadata.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    stored = _stored(tensors, dtype, exact)
    # The library gives its files to their owner alone; these get what the folder's others have.
    file.touch()
    mode = file.stat().st_mode
    try:
        # The library writes several entries in random order, and the same model as other bytes.
        save_file(stored, str(file), metadata={"about": about})
    except SafetensorError as error:
        raise OSError(str(error)) from error
    file.chmod(mode)
    with file.open("rb+") as written:
        os.fsync(written.fileno())


def _stored(tensors: Mapping[str, Tensor], dtype: str, exact: Collection[str]) -> dict[str, Tensor]:
    """The tensors as they are to be written, on the CPU; what is so already is not copied."""
    if dtype not in DTYPES:
        raise CheckpointError(f"dtype {dtype!r}; expected one of {', '.join(DTYPES)}")
    bad = not_finite(tensors)
    if bad is not None:
        raise CheckpointError(f"{bad} holds values that are not finite; nothing is written")
    stored: dict[str, Tensor] = {}
    places: set[int] = set()
    for name, tensor in tensors.items():
        kind = torch.float32 if name in exact else DTYPES[dtype]
        kept = tensor.detach().to("cpu", kind if tensor.is_floating_point() else tensor.dtype)
        kept = kept.contiguous()
        # Two views of one memory cannot be stored as they are.
        stored[name] = kept.clone() if kept.untyped_storage().data_ptr() in places else kept
        places.add(stored[name].untyped_storage().data_ptr())
    bad = not_finite(stored)
    if bad is not None:
        raise CheckpointError(
            f"{bad} reaches {float(tensors[bad].abs().max()):.3g}, too large for {dtype}; use "
            "bfloat16 or float32; nothing is written"
        )
    return stored
