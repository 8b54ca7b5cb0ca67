"""The state of a stage on disk: everything that an exact continuation needs, written atomically."""

from __future__ import annotations

import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from gvtools.errors import CheckpointError
from gvtools.files import replaced_when_written
from gvtools.networks.tensors import first_line
from gvtools.untrusted import archive

FILE = "state.pt"


@dataclass
class Progress:
    """Where a stage is.

    Attributes:
        step: optimiser steps made; the next sample is ``step`` x batch.
        skipped: batches that were left out, not finite or too large.
        seconds: spent so far.
        drawn: how often what happened when samples of a mixture were drawn, by note.
    """

    step: int = 0
    skipped: int = 0
    seconds: float = 0.0
    drawn: dict[str, int] = field(default_factory=dict)


@dataclass
class StageState:
    """What is saved.

    Attributes:
        identity: what must not change between the parts of a training.
        progress: see Progress.
        model: trainable parameters by name.
        optimizer: the optimiser's state.
        ema: the averages' state.
    """

    identity: dict[str, Any]
    progress: Progress = field(default_factory=Progress)
    model: dict[str, Any] = field(default_factory=dict)
    optimizer: dict[str, Any] = field(default_factory=dict)
    ema: dict[str, Any] = field(default_factory=dict)


def save_state(state: StageState, folder: Path) -> None:
    """Write the state; a kill or a full disk leaves the previous one whole."""
    content = {**vars(state), "progress": asdict(state.progress)}
    with replaced_when_written(folder / FILE) as part, part.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:
            # Torch's archive writer puts its own error over the system's.
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def load_state(
    folder: Path, identity: dict[str, Any], *, mapped: bool = False
) -> StageState | None:
    """The saved state, or None where there is none.

    Args:
        folder: of the stage.
        identity: what must not have changed.
        mapped: leave tensors in the file until they are used; for processes that use a part each.
    """
    path = folder / FILE
    if not path.exists():
        return None
    try:
        with archive(path):
            pass  # its members claim what they may
        _check_sums(path)
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
        state = StageState(**{**content, "progress": Progress(**content["progress"])})
    except Exception as error:
        raise CheckpointError(
            f"{path}: cannot be read ({first_line(error)}); start the stage again without --resume"
        ) from None
    difference = _difference(state.identity, identity)
    if difference is not None:
        key, before, now = difference
        raise CheckpointError(
            f"{path}: was trained with {key} = {before!r}, now {now!r}; use the same settings, or "
            "another --out"
        )
    return state


def _check_sums(path: Path) -> None:
    """Compare each member with its CRC-32, which torch's reader leaves out."""
    with zipfile.ZipFile(path) as archive:
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"{damaged} is damaged")


def saved_identity(folder: Path) -> dict[str, Any]:
    """Of the saved state; empty where there is none that can be read, which is said later."""
    try:
        with archive(folder / FILE):
            content = torch.load(folder / FILE, map_location="cpu", weights_only=True, mmap=True)
        return dict(content["identity"])
    except Exception:
        return {}


def _difference(before: Any, now: Any, where: str = "") -> tuple[str, Any, Any] | None:
    """The first entry of ``now`` that ``before`` has otherwise: its dotted name and both values."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in now:
            inside = f"{where}.{name}" if where else str(name)
            found = _difference(before.get(name), now[name], inside)
            if found is not None:
                return found
        return None
    return None if before == now else (where, before, now)
