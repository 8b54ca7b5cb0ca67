"""The last stage: the ray head of a small encoder alone, on features that stay as they are.

Cameras are read off the rays, and the encoder's stage, with five more terms, ends before they are
as good as its features allow.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.model import GeoVerse
from gvtools.training.batch import TrainingBatch
from gvtools.training.draws import Draws
from gvtools.training.encoder_stage import noised_features, ray_error, scene_unit, true_rays
from gvtools.training.options import RayStageOptions


class RayStage(nn.Module):
    """Loss of the rays; see the module."""

    name = "rays"

    def __init__(self, model: GeoVerse, options: RayStageOptions) -> None:
        super().__init__()
        self.model = model
        self.options = options
        model.requires_grad_(False)
        for part in model.geometry.head.ray_chain():
            part.requires_grad_(True)

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        model, options = self.model, self.options
        with torch.no_grad():
            levels = noised_features(model, batch, draws, options).levels
        grid = model.geometry.encoder.grid(*batch.views.size)
        found = model.geometry.head(levels, grid)
        loss = ray_error(found.ray, found.ray_confidence, batch, origin=options.origin)
        with torch.no_grad():
            cells = (found.ray.shape[-3], found.ray.shape[-2])
            error = (found.ray - true_rays(batch, scene_unit(batch), cells)).abs()
        terms = {"direction": error[..., :3].mean(), "origin": error[..., 3:].mean()}
        return loss, terms
