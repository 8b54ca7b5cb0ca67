"""The stage after the denoisers: the heads of a small model, on what its frozen denoisers make.

Colour and depth learn from completions, made in as many steps as in use: what is uncertain about
generated features, and where their tokens meet, the encoder's stage could not know. Cameras are
read off the rays, which that stage, with five more terms, leaves before they are as good as its
features allow. The layers that depth and rays share stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.composition import composed
from gvtools.completers.geoverse.objective import high_gradient_loss, rgb_loss
from gvtools.training.batch import TrainingBatch
from gvtools.training.draws import Draws
from gvtools.training.encoder_stage import (
    masked_mean,
    noised_features,
    ray_error,
    scene_unit,
    true_rays,
)
from gvtools.training.options import HeadsStageOptions
from gvtools.training.stage import Stage


class HeadsStage(Stage):
    """Loss of the heads; see the module."""

    name = "heads"

    options: HeadsStageOptions

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """The heads that have a weight."""
        model, options = self.model, self.options
        rays = model.geometry.head.ray_chain() if options.ray else []
        depth = model.geometry.head.depth_chain() if options.depth else []
        return [*rays, model.rgb_head if options.rgb else None, *depth]

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        options = self.options
        total = batch.images.new_zeros(())
        terms: dict[str, Tensor] = {}
        if options.ray:
            loss, terms = self._rays(batch, draws)
            total = total + options.ray * loss
        if options.rgb or options.depth:
            found = self._completions(batch, draws)
            color = found["rgb"] + options.hf * found["hf"] + options.decoded * found["rgb_decoded"]
            length = found["depth"] + options.decoded * found["depth_decoded"]
            total = total + options.rgb * color + options.depth * length
            terms |= found
        return total, terms

    def _rays(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        model, options = self.model, self.options
        with torch.no_grad():
            levels = noised_features(model, batch, draws, options=options).levels
        found = model.geometry.head(levels, model.geometry.encoder.grid(*batch.views.size))
        with torch.no_grad():
            cells = (found.ray.shape[-3], found.ray.shape[-2])
            error = (found.ray - true_rays(batch, scene_unit(batch), cells)).abs()
        loss = ray_error(found.ray, found.ray_confidence, batch, origin=options.origin)
        return loss, {"direction": error[..., :3].mean(), "origin": error[..., 3:].mean()}

    def _completions(self, batch: TrainingBatch, draws: Draws) -> dict[str, Tensor]:
        """Errors of the targets as inference makes them; gradients reach the heads alone."""
        model, context = self.model, batch.views.context
        with torch.no_grad():
            prepared = model.prepare(batch.views, seed=draws.seeds("video", batch.images.shape[1]))
            like = prepared.hints.level1
            level1 = model.sample1(
                prepared,
                draws.normal("eps1", like.shape, like.device),
                temperature=self.options.temperature,
            )
            level0 = model.sample0(prepared, level1, draws.normal("eps0", like.shape, like.device))
        made = model.decode(prepared, level0, level1, targets_alone=True)
        rgb, depth = batch.images[:, context:], batch.depth[:, context:, 0]
        # Decoded depth is in units of the mean context depth, a correction's in the scene's.
        scaled = depth / scene_unit(batch)[:, None, None, None]
        hint, wanted, judged = None, scaled, torch.ones_like(depth, dtype=torch.bool)
        if model.config.composition == "correction":
            # What memory knows is kept as it is.
            hint = model.decode(prepared, level0, prepared.hints.unmasked, targets_alone=True)
            wanted, judged = depth, ~batch.views.valid[:, context:, 0]
        image, length = composed(prepared.batch, made, hint)
        return {
            "rgb": rgb_loss(image, rgb, valid=judged).mean(),
            "hf": high_gradient_loss(image, rgb, valid=judged).mean(),
            "rgb_decoded": rgb_loss(made.rgb, rgb).mean(),
            "depth": log_error(length, wanted, judged),
            "depth_decoded": log_error(made.depth, scaled, depth > 0),
        }


def log_error(depth: Tensor, truth: Tensor, judged: Tensor) -> Tensor:
    """L1 of log-depths where both are known: mean over samples of each one's mean, or 0.

    Args:
        depth: (B, T, H, W); 0 = none.
        truth: likewise.
        judged: (B, T, H, W) bool, pixels that count.
    """
    judged = judged & (depth > 0) & (truth > 0)
    error = torch.where(judged, depth, 1.0).log() - torch.where(judged, truth, 1.0).log()
    return masked_mean(error.abs(), judged)
