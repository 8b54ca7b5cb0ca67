"""Stage 2: piecewise reflow distillation of level 1 into one step an interval."""

from __future__ import annotations

import copy

from torch import Tensor, nn

from gvtools.completers.geoverse.flow import (
    guided,
    interpolate,
    training_times,
    velocity_target,
)
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.objective.losses import flow_matching_loss
from gvtools.completers.geoverse.passes import Prepared
from gvtools.completers.geoverse.reflow import fast_loss, interval_times, reflow_pair
from gvtools.training.batch import TrainingBatch
from gvtools.training.draws import Draws
from gvtools.training.options import ReflowStageOptions

# The floor of the teacher's times, below any that its steps begin at.
LEAST = 1e-6


class ReflowStage(nn.Module):
    """Loss of stage 2: rho L_PRF + (1 - rho) L_FM; see the module.

    The student starts as the teacher. The cascade and the heads are not touched.
    """

    name = "reflow"

    def __init__(self, model: GeoVerse, options: ReflowStageOptions) -> None:
        super().__init__()
        self.model = model
        self.options = options
        model.requires_grad_(False)
        teacher = copy.deepcopy(model).eval()
        # Not a submodule: its weights are no part of the stage's state.
        self._teacher = [teacher]
        for part in (model.level1, model.control, model.shared):
            if part is not None:
                part.requires_grad_(True)
                for module in part.modules():
                    if hasattr(module, "W"):
                        module.W.requires_grad_(False)

    @property
    def bounds(self) -> tuple[float, ...]:
        """tau_0 .. tau_K."""
        return self.options.bounds or self.model.config.flow.level1

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        model, options = self.model, self.options
        teacher = self._teacher[0].to(batch.images.device)
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
            guided(
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
        settings = model.config.flow
        time = training_times(
            draws.uniform("t", 1)[:, 0], shift=settings.shift, most=settings.most_time
        ).to(device)
        state = interpolate(clean, noise, time)
        plain = model.velocity1(prepared, state, time)
        weight = options.context_weight
        reflow = flow_matching_loss(
            student,
            model.velocity_wanted(pair.velocity, pair.t),
            context=context,
            context_weight=weight,
        ).mean()
        flow = flow_matching_loss(
            plain,
            model.velocity_wanted(velocity_target(clean, noise), time),
            context=context,
            context_weight=weight,
        ).mean()
        return fast_loss(reflow, flow, rho=options.rho), {"reflow": reflow, "flow": flow}
