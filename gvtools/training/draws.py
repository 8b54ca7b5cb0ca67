"""Random draws of a training step that depend on the seed, the stage and each sample alone.

Not on the number of processes, on accumulation, or on what was drawn before: a resumed training and
one on several processes draw the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gvtools.completers.geoverse.flow import seeded_noise, view_seed


@dataclass(frozen=True)
class Draws:
    """Draws for one mini-batch.

    Attributes:
        seed: of the training.
        stage: its name.
        step: number of the optimiser step.
        samples: the numbers of the step's samples, B of them; none occurs twice in a training.
    """

    seed: int
    stage: str
    step: int
    samples: tuple[int, ...]

    def chance(self, name: str, share: float) -> bool:
        """Whether something happens in this step; the same for all samples and processes."""
        return float(self.numbers(name, 1)) < share

    def numbers(self, name: str, count: int) -> Tensor:
        """(count,) in [0, 1); the same for all samples and processes."""
        seed = view_seed(self.seed, self.stage, name, "step", self.step)
        return torch.rand(count, generator=torch.Generator().manual_seed(seed))

    def uniform(self, name: str, *shape: int) -> Tensor:
        """(B, *shape) in [0, 1), float32 on the CPU."""
        return torch.stack([torch.rand(shape, generator=g) for g in self._generators(name)])

    def normal(self, name: str, shape: Sequence[int], device: torch.device | str) -> Tensor:
        """(B, V, ...) standard normal, every view by itself."""
        return seeded_noise(shape, self.seeds(name, int(shape[1])), device=device)

    def seeds(self, name: str, views: int) -> list[list[int]]:
        """B rows of a seed for every view."""
        return [
            [view_seed(self.seed, self.stage, name, sample, view) for view in range(views)]
            for sample in self.samples
        ]

    def _generators(self, name: str) -> list[torch.Generator]:
        return [
            torch.Generator().manual_seed(view_seed(self.seed, self.stage, name, sample))
            for sample in self.samples
        ]
