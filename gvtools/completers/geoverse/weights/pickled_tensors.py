"""PyTorch's .pt files, read without running what they say: tensors and plain values alone."""

from __future__ import annotations

import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import torch

from gvtools.errors import CheckpointError

_ZIP, _PICKLE = b"PK\x03\x04", b"\x80"
_PLACEHOLDER = b"version https://git-lfs"


def read_pickled(path: Path) -> dict[str, Any]:
    """The dictionary of a .pt file, its tensors mapped from disk.

    Raises:
        CheckpointError: the file is absent, damaged, of another kind, or asks for code to be run.
    """
    check_not_placeholder(path)
    with path.open("rb") as file:
        start = file.read(len(_ZIP))
    if start != _ZIP:
        found = "a bare pickle, which may hold code" if start[:1] == _PICKLE else "no PyTorch file"
        raise CheckpointError(
            f"{path}: {found}; expected the zip form that torch.save writes since PyTorch 1.6, "
            "with tensors alone; download it again"
        )
    try:
        with warnings.catch_warnings():
            # About the protocol and deprecated classes of damaged files; what follows says more.
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(f"{path}: {_refused(error)}; nothing of it was run") from None
    except Exception as error:
        # What torch's reader stumbles upon in a damaged file, it raises as it comes.
        raise CheckpointError(
            f"{path}: cannot be read ({first_line(error)}); expected a whole PyTorch file of "
            "tensors; download it again"
        ) from None
    if not isinstance(content, dict):
        raise CheckpointError(
            f"{path}: holds a {type(content).__name__}; expected a dictionary of tensors by name"
        )
    return content


def check_not_placeholder(path: Path) -> None:
    """The file is there, and is more than what git leaves where a large file belongs.

    Raises:
        CheckpointError: it is absent, empty, or git's placeholder.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(_PLACEHOLDER))
    except FileNotFoundError:
        raise CheckpointError(f"no {path}; download it, see gvtools weights list") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not start:
        raise CheckpointError(f"{path}: is empty; download it again")
    if start == _PLACEHOLDER:
        raise CheckpointError(
            f"{path}: is Git LFS's placeholder of {path.stat().st_size} bytes, not the file "
            "itself; fetch that with git lfs pull"
        )


def _refused(error: Exception) -> str:
    """What a pickle asks for that is not loaded."""
    asked = re.search(r"GLOBAL ([\w.]+)|WeightsUnpickler error: ([^\n]+)", str(error))
    if asked is None:
        return f"is refused ({first_line(error)}); expected tensors and plain values alone"
    if asked[1]:
        return f"asks for {asked[1]}; expected tensors and plain values alone, without code"
    return f"cannot be read ({asked[2].strip()}); expected a whole file of tensors alone"


def first_line(error: Exception) -> str:
    """An error's first line, at most one sentence of it."""
    text = str(error).strip().splitlines()
    return text[0].split(". ")[0] if text else type(error).__name__
