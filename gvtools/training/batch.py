"""Inputs of a training step: a batch of views with their truth, and its random draws.

Draws depend on the seed, the stage and each sample alone; not on the number of processes, on
accumulation, or on earlier draws: a resumed training and one on several processes draw the same
numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.flow import seeded_noise, view_seed


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """Views with their hints, and the truth of all of them."""

    # as the model gets them: context pictures and depth, then the targets' projections
    views: ViewBatch
    images: Tensor  # (B, V, 3, H, W) true pictures in [0, 1]
    depth: Tensor  # (B, V, 1, H, W) true z-depth; 0 = unknown
    # how often what happened when its samples were drawn
    notes: Mapping[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.images)

    @property
    def true_views(self) -> ViewBatch:
        """The same views with true pictures and depth everywhere."""
        return replace(
            self.views,
            images=self.images,
            depth=self.depth,
            valid=torch.ones_like(self.views.valid),
        )

    @property
    def unprojected(self) -> TrainingBatch:
        """The same views with nothing projected into the targets."""
        context = self.views.context
        known = torch.zeros_like(self.views.valid)
        known[:, :context] = True
        views = replace(
            self.views,
            images=self.views.images * known,
            depth=self.views.depth * known,
            valid=self.views.valid & known,
        )
        return replace(self, views=views)

    @property
    def relative(self) -> Tensor:
        """(B, V, 4, 4) float64 cameras from the frame of the first view."""
        pose = self.views.cam_from_world.double()
        return pose @ torch.linalg.inv(pose[:, :1])

    @property
    def centers(self) -> Tensor:
        """(B, V, 3) true camera centres in the frame of the first view."""
        rotation, translation = self.relative[..., :3, :3], self.relative[..., :3, 3:]
        return -(rotation.mT @ translation)[..., 0].to(self.images.dtype)

    def samples(self, index: Tensor) -> TrainingBatch:
        """Some samples of the batch, without its notes."""
        return TrainingBatch(self.views.samples(index), self.images[index], self.depth[index])

    def to(self, device: torch.device | str) -> TrainingBatch:
        """On another device."""
        images, depth = self.images.to(device), self.depth.to(device)
        return TrainingBatch(self.views.to(device), images, depth, self.notes)


@dataclass(frozen=True)
class Draws:
    """Draws for one mini-batch."""

    seed: int  # of the training
    stage: str  # its name
    step: int  # number of the optimiser step
    # the numbers of the step's samples, B of them; none occurs twice in a training
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
