"""Stages of the denoisers: joint training of both levels, and distillation of level 1."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.composition import compose
from gvtools.completers.geoverse.flow import (
    clean_from_velocity,
    fast_loss,
    guide,
    interpolate,
    interval_times,
    reflow_pair,
    training_times,
    velocity_target,
)
from gvtools.completers.geoverse.model import GeoVerse, Prepared
from gvtools.completers.geoverse.objective import (
    PredictedTerms,
    ReferenceTerms,
    flow_matching_loss,
    objective,
)
from gvtools.networks.compute import set_recompute
from gvtools.networks.depth_anything.rays import camera_centres
from gvtools.training.batch import Draws, TrainingBatch
from gvtools.training.options import DenoiserStageOptions, ReflowStageOptions


class Stage(nn.Module):
    """A model in training; all but its ``learning_parts`` is frozen."""

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
            PredictedTerms(**predicted),
            ReferenceTerms(**wanted),
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
        image, depth = compose(prepared.batch, decoded, hint)
        centers = batch.centers
        if not correction:
            # A correction has the scale of the projection; a decoding has that of its centres.
            centers = camera_centres(decoded.geometry.ray, decoded.geometry.ray_confidence)
        return {"image": image, "depth": depth, "centers": centers}


# The floor of the teacher's times, below any that its steps begin at.
LEAST = 1e-6


class ReflowStage(Stage):
    """Loss of stage 2: rho L_PRF + (1 - rho) L_FM; see the module.

    The student starts as the teacher. The cascade and the heads are not touched.
    """

    name = "reflow"

    options: ReflowStageOptions

    def __init__(self, model: GeoVerse, options: ReflowStageOptions) -> None:
        super().__init__(model, options)
        teacher = copy.deepcopy(model).eval().requires_grad_(False)
        # Not a submodule: its weights are no part of the stage's state.
        self._teacher = [teacher]

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """Level 1, and what steers it."""
        return self.model.level1, self.model.control, self.model.shared

    @property
    def bounds(self) -> tuple[float, ...]:
        """tau_0 .. tau_K."""
        return self.options.bounds or self.model.config.flow.level1

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        model, options = self.model, self.options
        teacher = self._teacher[0]
        seeds = draws.seeds("video", batch.images.shape[1])
        prepared = model.prepare(batch.views, seed=seeds)
        _, clean = model.clean_latents(batch.true_views)
        device = clean.device
        context = batch.views.context
        noise = draws.normal("eps", clean.shape, device)
        intervals, t = interval_times(
            draws.uniform("interval", 1)[:, 0], draws.uniform("t_inside", 1)[:, 0], self.bounds
        )
        known = teacher.prepare(batch.views, seed=seeds) if options.rho > 0 else prepared

        def taught(conditions: Prepared, state: Tensor, time: Tensor) -> Tensor:
            # As in sampling: with the floor, short last steps would leave noise behind.
            return teacher.velocity1(conditions, state, time, least=LEAST)

        without = teacher.without_cameras(known) if options.cfg_scale != 1 else known
        pair = reflow_pair(
            guide(
                lambda state, time: taught(known, state, time),
                lambda state, time: taught(without, state, time),
                options.cfg_scale,
            ),
            clean,
            noise,
            intervals=intervals,
            t=t,
            bounds=self.bounds,
            steps=options.steps,
            shift=model.config.flow.shift,
        )
        student = model.velocity1(prepared, pair.state, pair.t)
        time = self.time(draws, "t").to(device)
        state = interpolate(clean, noise, time)
        plain = model.velocity1(prepared, state, time)

        def error(found: Tensor, wanted: Tensor, at: Tensor) -> Tensor:
            return flow_matching_loss(
                found,
                model.velocity_wanted(wanted, at),
                context=context,
                context_weight=options.context_weight,
            ).mean()

        reflow = error(student, pair.velocity, pair.t)
        flow = error(plain, velocity_target(clean, noise), time)
        return fast_loss(reflow, flow, rho=options.rho), {"reflow": reflow, "flow": flow}
