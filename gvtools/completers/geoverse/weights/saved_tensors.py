"""Writing tensors to disk: nothing that could not be loaded again."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path

import torch
from torch import Tensor

from gvtools.completers.geoverse.weights.checkpoints import not_finite
from gvtools.errors import CheckpointError

DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


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

    Raises:
        CheckpointError: numbers that are not finite, or too large for ``dtype``.
        OSError: the disk is full, or the file cannot be written.
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
