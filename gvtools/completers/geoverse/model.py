"""GeoVerse: the whole model, from views and projections to target pictures, depth and rays.

Data flow of one pass (tensor shapes in the README.md beside this file; equations are the paper's)::

    pictures, projections --filled--> encode_hints (Eq. 1) --> hints
    hints, cameras, depth --> Conditions;  video prior --> control residuals | shared keys (once)
    noise --level-1 denoiser, K Euler steps--> level 1 --cascade, 1 step--> level 0
    level 1 --frozen blocks--> levels 2, 3;  all four --heads--> pictures, depth, rays
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gvtools.completers.geoverse import stages
from gvtools.completers.geoverse.conditioning import (
    ViewBatch,
)
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.denoiser import Positions
from gvtools.completers.geoverse.flow import (
    check_bounds,
    sample,
)
from gvtools.completers.geoverse.model_networks import GeoVerseNetworks
from gvtools.completers.geoverse.noise import seeded_noise, view_seed
from gvtools.completers.geoverse.passes import Decoded, Generated, Prepared
from gvtools.completers.geoverse.stages import Clock, no_clock
from gvtools.completers.geoverse.video_prior.prior import VideoFeatures
from gvtools.errors import CheckpointError, GvError
from gvtools.networks.tensor_files import first_line

__all__ = ["Decoded", "Generated", "GeoVerse", "Prepared"]


class GeoVerse(GeoVerseNetworks):
    """The whole model: its networks, and the passes that sample and decode with them."""

    def sample1(
        self,
        prepared: Prepared,
        noise: Tensor,
        *,
        bounds: Sequence[float] | None = None,
        cfg_scale: float | None = None,
        temperature: float | None = None,
        clock: Clock = no_clock,
    ) -> Tensor:
        """Level-1 latents from (B, V, C, h, w) noise, one Euler step an interval.

        Args:
            prepared: what stays constant.
            noise: (B, V, C, h, w).
            bounds: see ``generate``, as the others.
            cfg_scale: of classifier-free guidance over the cameras.
            temperature: of the noise.
            clock: receives the stages' names.
        """
        flow = self.config.flow
        noise = noise * (flow.temperature if temperature is None else temperature)
        scale = flow.cfg_scale if cfg_scale is None else cfg_scale
        without = self.without_cameras(prepared) if scale != 1 else prepared
        tau = check_bounds(bounds or flow.level1)
        # The floor is for training. A step from t goes (t - next) / t of the way to the clean
        # latents, however small t is; with the floor, short last steps would leave noise behind.
        least = min(flow.least_time, tau[-2])

        def velocity(state: Tensor, t: Tensor) -> Tensor:
            with clock(stages.LEVEL1):
                return self.velocity1(prepared, state, t, least=least)

        def unconditional(state: Tensor, t: Tensor) -> Tensor:
            with clock(stages.LEVEL1):
                return self.velocity1(without, state, t, least=least)

        return sample(velocity, noise, tau, unconditional=unconditional, cfg_scale=scale)

    def sample0(
        self,
        prepared: Prepared,
        level1: Tensor,
        noise: Tensor,
        *,
        bounds: Sequence[float] | None = None,
        cfg_scale: float | None = None,
        clock: Clock = no_clock,
    ) -> Tensor:
        """Level-0 latents of (B, V, C, h, w) level-1 latents; the mean without a cascade."""
        if self.cascade is None:
            return torch.zeros_like(level1)
        cascade = self.cascade
        conditions = self.cascade_conditions(prepared, level1)
        grid = (level1.shape[-2], level1.shape[-1])
        positions = Positions(cascade.config, conditions.camera, grid)

        def velocity(state: Tensor, t: Tensor) -> Tensor:
            with clock(stages.LEVEL0):
                return cascade(state, t, conditions, positions=positions)

        flow = self.config.flow
        scale = flow.cascade_cfg_scale if cfg_scale is None else cfg_scale
        if scale == 1:
            return sample(velocity, noise, bounds or flow.cascade)
        # As GLD's evaluation runs its cascade: poses are dropped, intrinsics kept.
        without = replace(conditions, camera=conditions.camera.unconditional("old"))
        elsewhere = Positions(cascade.config, without.camera, grid)

        def unconditional(state: Tensor, t: Tensor) -> Tensor:
            with clock(stages.LEVEL0):
                return cascade(state, t, without, positions=elsewhere)

        return sample(
            velocity, noise, bounds or flow.cascade, unconditional=unconditional, cfg_scale=scale
        )

    @torch.no_grad()
    def generate(
        self,
        batch: ViewBatch,
        *,
        seed: int = 0,
        names: Sequence[Sequence[int | str]] | None = None,
        bounds: Sequence[float] | None = None,
        cascade_bounds: Sequence[float] | None = None,
        cfg_scale: float | None = None,
        cascade_cfg_scale: float | None = None,
        temperature: float | None = None,
        video: VideoFeatures | None = None,
        targets_alone: bool = False,
        clock: Clock = no_clock,
    ) -> Generated:
        """One pass: prepare, sample level 1 and level 0, decode.

        Args:
            batch: context views, then targets.
            seed: of all noise.
            names: B rows of V names; a view's noise depends on the seed and its name alone. Its
                index by default.
            bounds: level-1 interval bounds; the configuration's by default. Empty: nothing is
                denoised, and the hints' own features stand for level 1.
            cascade_bounds: level-0 interval bounds; the configuration's by default.
            cfg_scale: of classifier-free guidance; the configuration's by default.
            cascade_cfg_scale: likewise, of level 0.
            temperature: of level 1; the configuration's by default.
            video: features computed before, for the same views.
            targets_alone: without all views' geometry; the same pictures and depth, sooner.
            clock: receives the stages' names.
        """
        rows = names or [list(range(batch.images.shape[1]))] * len(batch.images)

        def seeds(draw: str) -> list[list[int]]:
            return [[view_seed(seed, draw, name) for name in row] for row in rows]

        prepared = self.prepare(batch, seed=seeds("video"), video=video, clock=clock)
        like = prepared.hints.level1

        def noise(level: str) -> Tensor:
            return seeded_noise(like.shape, seeds(level), device=like.device)

        level1 = prepared.hints.unmasked
        if bounds is None or len(bounds):
            level1 = self.sample1(
                prepared,
                noise("level1"),
                bounds=bounds,
                cfg_scale=cfg_scale,
                temperature=temperature,
                clock=clock,
            )
        level0 = self.sample0(
            prepared,
            level1,
            noise("level0"),
            bounds=cascade_bounds,
            cfg_scale=cascade_cfg_scale,
            clock=clock,
        )
        with clock(stages.DECODE):
            decoded = self.decode(
                prepared, level0, level1, targets_alone=targets_alone, clock=clock
            )
            hint = self.decoded_hint(prepared, level0, clock=clock)
        return Generated(level1, level0, decoded, hint)

    def decoded_hint(
        self, prepared: Prepared, level0: Tensor, *, clock: Clock = no_clock
    ) -> Decoded | None:
        """What the filled projections' own features decode to, where completions correct that."""
        if self.config.composition != "correction":
            return None
        unmasked = prepared.hints.unmasked
        return self.decode(prepared, level0, unmasked, targets_alone=True, clock=clock)


def empty_model(config: GeoVerseConfig, *, where: object) -> GeoVerse:
    """The model on the meta device: names and shapes, no numbers, no memory."""
    try:
        with torch.device("meta"):
            return GeoVerse(config)
    except GvError:
        raise
    except Exception as error:
        # Dimensions that do not divide, that are negative or zero: each module has its own way.
        raise CheckpointError(
            f"{where}: no network comes of configuration {config.name!r} ({first_line(error)}); "
            "expected dimensions that fit each other, such as those of base or tiny"
        ) from error
