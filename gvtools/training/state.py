"""Averaged weights, and a stage's state on disk: all that an exact continuation needs."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.errors import CheckpointError
from gvtools.files import replaced_when_written
from gvtools.networks.tensors import first_line
from gvtools.untrusted import archive


class AveragedWeights:
    """Averages of named parameters, shadow = decay shadow + (1 - decay) parameter.

    The first updates average faster, (1 + n) / (10 + n) up to the decay, so that a short training
    is not dominated by its start.
    """

    def __init__(self, parameters: Iterable[tuple[str, nn.Parameter]], decay: float) -> None:
        self.decay = decay
        self.updates = 0
        self._parameters = dict(parameters)
        self.shadow = {name: p.detach().clone() for name, p in self._parameters.items()}

    @torch.no_grad()
    def update(self) -> None:
        """Take one step of the parameters into account."""
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        self.updates += 1
        names = list(self.shadow)
        torch._foreach_lerp_(
            [self.shadow[name] for name in names],
            [self._parameters[name].detach() for name in names],
            1 - decay,
        )

    @contextmanager
    def swapped_in(self) -> Iterator[None]:
        """The parameters hold their averages within the block."""
        kept = {name: p.detach().clone() for name, p in self._parameters.items()}
        self._put(self.shadow)
        try:
            yield
        finally:
            self._put(kept)

    @torch.no_grad()
    def _put(self, values: Mapping[str, Tensor]) -> None:
        for name, parameter in self._parameters.items():
            parameter.copy_(values[name])

    def state_dict(self) -> dict[str, object]:
        """For a checkpoint."""
        return {"updates": self.updates, "shadow": self.shadow}

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """From a checkpoint."""
        self.updates = int(state["updates"])  # type: ignore[call-overload]
        shadow: Mapping[str, Tensor] = state["shadow"]  # type: ignore[assignment]
        with torch.no_grad():
            for name, value in self.shadow.items():
                value.copy_(shadow[name])


FILE = "state.pt"


@dataclass
class TrainingProgress:
    """Where a stage is."""

    step: int = 0  # optimiser steps made; the next sample is ``step`` x batch
    skipped: int = 0  # batches that were left out, not finite or too large
    seconds: float = 0.0  # spent so far
    # how often what happened when samples of a mixture were drawn, by note
    drawn: dict[str, int] = field(default_factory=dict)


@dataclass
class StageState:
    """What is saved."""

    identity: dict[str, Any]  # what must not change between the parts of a training
    progress: TrainingProgress = field(default_factory=TrainingProgress)  # see TrainingProgress
    model: dict[str, Any] = field(default_factory=dict)  # trainable parameters by name
    optimizer: dict[str, Any] = field(default_factory=dict)  # the optimiser's state
    ema: dict[str, Any] = field(default_factory=dict)  # the averages' state


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
    """The saved state, or None where there is none."""
    path = folder / FILE
    if not path.exists():
        return None
    try:
        with archive(path):
            pass  # its members claim what they may
        _check_sums(path)
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
        state = StageState(**{**content, "progress": TrainingProgress(**content["progress"])})
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
