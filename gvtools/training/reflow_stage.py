"""Stage 2: piecewise reflow distillation of level 1 into one step an interval."""

from __future__ import annotations

import copy
from collections.abc import Iterable

from torch import Tensor, nn

from gvtools.completers.geoverse.flow import (
    fast_loss,
    guided,
    interpolate,
    interval_times,
    reflow_pair,
    velocity_target,
)
from gvtools.completers.geoverse.model import GeoVerse, Prepared
from gvtools.completers.geoverse.objective import flow_matching_loss
from gvtools.training.batch import TrainingBatch
from gvtools.training.draws import Draws
from gvtools.training.options import ReflowStageOptions
from gvtools.training.stage import Stage

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
