"""Stage 1: the level-1 denoiser and the level-0 cascade under the complete objective (Eq. 7)."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.composition import composed
from gvtools.completers.geoverse.flow import (
    clean_from_velocity,
    interpolate,
    velocity_target,
)
from gvtools.completers.geoverse.model import Prepared
from gvtools.completers.geoverse.objective import Prediction, Reference, objective
from gvtools.networks.depth_anything.rays import camera_centres
from gvtools.training.batch import TrainingBatch
from gvtools.training.draws import Draws
from gvtools.training.options import DenoiserStageOptions
from gvtools.training.stage import Stage


class DenoiserStage(Stage):
    """Loss of stage 1; see the module."""

    name = "denoiser"

    options: DenoiserStageOptions

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """Both denoisers and what they share."""
        return self.model.level1, self.model.cascade, self.model.control, self.model.shared

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        model, options = self.model, self.options
        prepared = model.prepare(batch.views, seed=draws.seeds("video", batch.images.shape[1]))
        clean0, clean1 = model.clean_latents(batch.true_views)
        device = clean1.device
        drop = draws.uniform("cameras", 1)[:, 0] < options.cameras
        if options.cameras and bool(drop.any()):
            prepared = model.without_cameras(prepared, drop.to(device))

        t1 = self.time(draws, "t1").to(device)
        noise1 = draws.normal("eps1", clean1.shape, device)
        state1 = interpolate(clean1, noise1, t1)
        velocity1 = model.velocity1(prepared, state1, t1)
        predicted = {"level1": velocity1}
        wanted = {"level1": model.velocity_wanted(velocity_target(clean1, noise1), t1)}

        found0 = torch.zeros_like(clean1)
        if model.cascade is not None:
            t0 = self.time(draws, "t0").to(device)
            noise0 = draws.normal("eps0", clean0.shape, device)
            state0 = interpolate(clean0, noise0, t0)
            amount = options.source_noise * draws.uniform("source", 1, 1, 1, 1).to(device)
            source = clean1 + amount * draws.normal("source_eps", clean1.shape, device)
            velocity0 = model.cascade(state0, t0, model.cascade_conditions(prepared, source))
            predicted["level0"] = velocity0
            wanted["level0"] = velocity_target(clean0, noise0)
            found0 = clean_from_velocity(velocity0, state0, t0)

        if draws.chance("decode", options.decode):
            found1 = clean_from_velocity(velocity1, state1, t1)
            context = batch.views.context
            predicted |= self._decoded(prepared, found0, found1, batch=batch)
            wanted |= {
                "image": batch.images[:, context:],
                "depth": batch.depth[:, context:, 0],
                "centers": batch.centers,
            }
            if model.config.composition == "correction":
                # What memory knows is kept as it is.
                holes = ~batch.views.valid[:, context:, 0]
                wanted |= {"image_valid": holes, "depth_valid": holes}
        result = objective(
            Prediction(**predicted),
            Reference(**wanted),
            context=batch.views.context,
            weights=options.weights,
            context_weight=options.context_weight,
        )
        return result.total, {**result.terms, **result.counts}

    def _decoded(
        self, prepared: Prepared, level0: Tensor, level1: Tensor, *, batch: TrainingBatch
    ) -> dict[str, Tensor]:
        """Target pictures and depth with all camera centres, composed as inference does."""
        model = self.model
        correction = model.config.composition == "correction"
        decoded = model.decode(prepared, level0, level1, targets_alone=correction)
        hint = None
        if correction:
            with torch.no_grad():
                unmasked = prepared.hints.unmasked
                hint = model.decode(prepared, level0, unmasked, targets_alone=True)
        image, depth = composed(prepared.batch, decoded, hint)
        centers = batch.centers
        if not correction:
            # A correction has the scale of the projection; a decoding has that of its centres.
            centers = camera_centres(decoded.geometry.ray, decoded.geometry.ray_confidence)
        return {"image": image, "depth": depth, "centers": centers}
