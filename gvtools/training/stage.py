"""What the stages of a training have in common: a model of which some parts learn, and a loss."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import Tensor, nn

from gvtools.completers.geoverse.flow import training_times
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.networks.compute import set_recompute
from gvtools.training.batch import TrainingBatch
from gvtools.training.draws import Draws


class Stage(nn.Module):
    """A model in training; all but its ``learning_parts`` is frozen.

    Args:
        model: changed.
        options: of the stage.
    """

    name: str
    options: Any

    def __init__(self, model: GeoVerse, options: Any) -> None:
        super().__init__()
        self.model, self.options = model, options
        model.requires_grad_(False)
        set_recompute(model, options.optimizer.recompute)
        for part in self.learning_parts():
            if part is not None:
                part.requires_grad_(True)
                for module in part.modules():
                    # Frequencies of an embedding of times.
                    if hasattr(module, "W"):
                        module.W.requires_grad_(False)

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """The parts of the model that are trained; None for one that it does not have."""
        raise NotImplementedError

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        raise NotImplementedError

    def time(self, draws: Draws, name: str) -> Tensor:
        """(B,) times of flow matching, uniform before the shift; on the CPU."""
        flow = self.model.config.flow
        return training_times(draws.uniform(name, 1)[:, 0], shift=flow.shift, most=flow.most_time)
