"""What each process holds of a stage in training: here a copy of everything.

``shards.Shards`` has the same methods for processes that share parameters out among them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn

from gvtools.completers.geoverse.model import GeoVerse
from gvtools.training.processes import Processes


class Copies:
    """All parameters, gradients, averages and moments on every process.

    Args:
        stage: the module in training; moved to the process's device with all that it uses.
        processes: this process and the others.
    """

    # Whether all processes have to take part in whatever the model does.
    together = False
    # For the user; empty where there is nothing to say.
    about = ""

    def __init__(self, stage: nn.Module, processes: Processes) -> None:
        self.stage, self.processes = stage, processes
        self._distribute()

    def _distribute(self) -> None:
        device = self.processes.device
        self.stage.to(device)
        for model in models_of(self.stage):
            model.to(device)
            if model.video is not None:
                model.video.to(device)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Mean of the gradients over all processes."""
        self.processes.average_gradients(parameters)

    def number(self, norm: Tensor) -> float:
        """A norm over all parameters."""
        return float(norm)

    def gathered(self, state: Any) -> Any:
        """Nested dictionaries and lists with whole tensors; for the first process alone."""
        return state

    def placed(self, whole: Tensor, like: Tensor) -> Tensor:
        """What a process holds of a whole tensor, as it does of ``like``."""
        return whole

    @contextmanager
    def usable(self) -> Iterator[None]:
        """Within the block, the model may be used outside of the stage's ``forward``."""
        yield

    def whole_model(self, model: GeoVerse) -> GeoVerse | None:
        """The model with whole tensors; None on all processes but the first."""
        return model if self.processes.first else None


def models_of(stage: nn.Module) -> list[GeoVerse]:
    """The models that a stage uses: its own, and those that it keeps in a list.

    What lies in a list is no part of a module's state: the teacher of the distillation.
    """
    listed = [item for value in vars(stage).values() if isinstance(value, list) for item in value]
    return [model for model in (*stage.children(), *listed) if isinstance(model, GeoVerse)]
