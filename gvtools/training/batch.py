"""What a training step is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gvtools.completers.geoverse.conditioning import ViewBatch


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """Views with their hints, and the truth of all of them.

    Attributes:
        views: as the model gets them: context pictures and depth, then the targets' projections.
        images: (B, V, 3, H, W) true pictures in [0, 1].
        depth: (B, V, 1, H, W) true z-depth; 0 = unknown.
        notes: how often what happened when its samples were drawn.
    """

    views: ViewBatch
    images: Tensor
    depth: Tensor
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
