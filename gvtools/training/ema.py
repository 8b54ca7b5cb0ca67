"""Exponentially averaged weights."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class AveragedWeights:
    """Averages of named parameters, shadow = decay shadow + (1 - decay) parameter.

    The first updates average faster, (1 + n) / (10 + n) up to the decay, so that a short training
    is not dominated by its start.

    Args:
        parameters: name and parameter; averages start at their values.
        decay: of the averages.
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
