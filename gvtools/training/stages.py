"""Stages of the denoisers: joint flow matching of both levels, and distillation of level 1.

``DenoiserStage`` computes the paper's complete objective: flow matching of the latents of level 1
(coarse) and level 0 (fine, predicted by the cascade from level 1), and errors of pictures, depth
and camera centres that are decoded from the clean latents which the velocities point back to.
``ReflowStage`` distils level 1: a frozen copy of the denoiser, the teacher, makes many Euler steps
in an interval of time, and the student learns to get as far in one. ``geoverse.flow`` holds the
formulas: state x_t = (1 - t) clean + t noise, velocity noise - clean.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.composition import compose
from gvtools.completers.geoverse.flow import (
    clean_from_velocity,
    guide,
    interpolate,
    interval_times,
    reflow_pair,
    training_times,
    velocity_target,
)
from gvtools.completers.geoverse.model import GeoVerse, Prepared
from gvtools.completers.geoverse.objective import flow_matching_loss, objective
from gvtools.networks.compute import set_recompute
from gvtools.networks.depth_anything.geometry_head import camera_centres
from gvtools.training.options import DenoiserStageOptions, ReflowStageOptions
from gvtools.training.samples import Draws, TrainingBatch

# A floor below all times that the teacher's steps begin at: with the floor of training, short last
# steps would leave noise behind.
TEACHER_LEAST_TIME = 1e-6


class Stage(nn.Module):
    """A model with the loss that one stage minimises; all but ``learning_parts`` is frozen.

    A call takes a batch with the random draws of its step, and gives the loss with its terms for
    the log.
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

    def prepare(self, batch: TrainingBatch, draws: Draws) -> Prepared:
        """The batch as the model takes it."""
        return self.model.prepare(batch.views, seed=draws.seeds("video", batch.images.shape[1]))

    def noisy_state(
        self, clean: Tensor, noise: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """State x_t (B, ...), its t (B,) and its velocity, at a time of ``uniform`` (B, 1)."""
        flow = self.model.config.flow
        t = training_times(uniform[:, 0], shift=flow.shift, most=flow.most_time).to(clean.device)
        return interpolate(clean, noise, t), t, velocity_target(clean, noise)


class DenoiserStage(Stage):
    """Both denoisers, trained together under the complete objective."""

    name = "denoiser"

    options: DenoiserStageOptions

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """Both denoisers and what they share."""
        return self.model.level1, self.model.cascade, self.model.control, self.model.shared

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        model, options = self.model, self.options
        prepared = self.prepare(batch, draws)
        clean0, clean1 = model.clean_latents(batch.true_views)
        device = clean1.device
        drop = draws.uniform("cameras", 1)[:, 0] < options.cameras
        if options.cameras and bool(drop.any()):
            prepared = model.without_cameras(prepared, drop.to(device))

        # Level 1: the velocity from a noisy state.
        noise1 = draws.normal("eps1", clean1.shape, device)
        state1, t1, true_velocity1 = self.noisy_state(clean1, noise1, draws.uniform("t1", 1))
        velocity1 = model.velocity1(prepared, state1, t1)
        predicted = {"level1": velocity1}
        truth = {"level1": model.velocity_wanted(true_velocity1, t1)}

        # Level 0: likewise, on the condition of a true level 1 with a little noise.
        level0 = torch.zeros_like(clean1)
        if model.cascade is not None:
            noise0 = draws.normal("eps0", clean0.shape, device)
            state0, t0, truth["level0"] = self.noisy_state(clean0, noise0, draws.uniform("t0", 1))
            amount = options.source_noise * draws.uniform("source", 1, 1, 1, 1).to(device)
            source = clean1 + amount * draws.normal("source_eps", clean1.shape, device)
            velocity0 = model.cascade(state0, t0, model.cascade_conditions(prepared, source))
            predicted["level0"] = velocity0
            level0 = clean_from_velocity(velocity0, state0, t0)

        # Pictures, depth and camera centres of the clean latents that these velocities mean.
        if draws.chance("decode", options.decode):
            level1 = clean_from_velocity(velocity1, state1, t1)
            context = batch.views.context
            predicted |= self._decode(prepared, level0, level1, batch=batch)
            truth |= {
                "image": batch.images[:, context:],
                "depth": batch.depth[:, context:, 0],
                "centers": batch.centers,
            }
            if model.config.composition == "correction":
                # What memory knows is kept as it is.
                holes = ~batch.views.valid[:, context:, 0]
                truth |= {"image_valid": holes, "depth_valid": holes}
        result = objective(
            predicted,
            truth,
            context=batch.views.context,
            weights=dict(options.weights),
            context_weight=options.context_weight,
        )
        return result.total, {**result.terms, **result.counts}

    def _decode(
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
        image, depth = compose(prepared.batch, decoded, hint)
        centers = batch.centers
        if not correction:
            # A correction has the scale of the projection; a decoding has that of its centres.
            centers = camera_centres(decoded.geometry.ray, decoded.geometry.ray_confidence)
        return {"image": image, "depth": depth, "centers": centers}


class ReflowStage(Stage):
    """Level 1 of a student that starts as its teacher: rho L_PRF + (1 - rho) L_FM.

    L_PRF compares the student's velocity with the teacher's displacement over one interval, L_FM
    with the velocity to the truth. The cascade and the heads are not touched.
    """

    name = "reflow"

    options: ReflowStageOptions

    def __init__(self, model: GeoVerse, options: ReflowStageOptions) -> None:
        super().__init__(model, options)
        # In a list, so that its weights are no part of the stage's state.
        self._teacher = [copy.deepcopy(model).eval().requires_grad_(False)]

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """Level 1, and what steers it."""
        return self.model.level1, self.model.control, self.model.shared

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        model, options, flow = self.model, self.options, self.model.config.flow
        # Once for both: the encoder and the video model are frozen. What takes their features in is
        # not, so that the teacher's is by its own weights, with guidance if that is asked for.
        seed = draws.seeds("video", batch.images.shape[1])
        video = model.video_features(batch.views, seed=seed)
        prepared = model.prepare(batch.views, video=video)
        teacher, scale = self._teacher[0], options.cfg_scale
        taught = teacher.with_video(prepared, video)
        taught = taught if scale == 1 else teacher.without_and_with_cameras(taught)

        def velocity(state: Tensor, t: Tensor) -> Tensor:
            return teacher.velocity1(taught, state, t, least=TEACHER_LEAST_TIME)

        _, clean = model.clean_latents(batch.true_views)
        bounds = options.bounds or flow.level1
        intervals, t = interval_times(
            draws.uniform("interval", 1)[:, 0], draws.uniform("t_inside", 1)[:, 0], bounds
        )
        noise = draws.normal("eps", clean.shape, clean.device)
        pair = reflow_pair(
            guide(velocity, scale),
            clean,
            noise,
            intervals=intervals,
            t=t,
            bounds=bounds,
            steps=options.steps,
            shift=flow.shift,
        )
        reflow = self._error(prepared, pair.state, pair.t, velocity=pair.velocity)
        state, time, wanted = self.noisy_state(clean, noise, draws.uniform("t", 1))
        matching = self._error(prepared, state, time, velocity=wanted)
        total = options.rho * reflow + (1 - options.rho) * matching
        return total, {"reflow": reflow, "flow": matching}

    def _error(self, prepared: Prepared, state: Tensor, t: Tensor, *, velocity: Tensor) -> Tensor:
        """The loss of the student's velocity at a state, against the given one."""
        return flow_matching_loss(
            self.model.velocity1(prepared, state, t),
            self.model.velocity_wanted(velocity, t),
            context=prepared.batch.context,
            context_weight=self.options.context_weight,
        ).mean()
