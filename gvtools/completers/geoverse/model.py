"""GeoVerse: the whole model, from views and projections to target pictures, depth and rays.

Data flow of one pass (tensor shapes in the README.md beside this file; equations are the paper's)::

    pictures, projections --filled--> encode_hints (Eq. 1) --> hints
    hints, cameras, depth --> Conditions;  video prior --> control residuals | shared keys (once)
    noise --level-1 denoiser (Eq. 2), K Euler steps--> level 1 --cascade (Eq. 3)--> level 0
    level 1 --frozen blocks--> levels 2, 3;  all four --heads--> pictures, depth, rays
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.camera_encoding import camera_condition
from gvtools.completers.geoverse.conditioning import (
    Hints,
    LatentStatistics,
    ViewBatch,
    depth_condition,
    encode_hints,
    encode_latents,
    filled,
)
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.denoiser import Conditions, Denoiser, Positions, VideoKeys
from gvtools.completers.geoverse.flow import (
    check_bounds,
    over_state,
    sample,
    seeded_noise,
    velocity_from_clean,
    view_seed,
)
from gvtools.completers.geoverse.refiner import Refiner
from gvtools.completers.geoverse.rgb_head import RGBHead
from gvtools.completers.geoverse.video_injection import ControlBranch, SharedAttention, video_keys
from gvtools.completers.geoverse.video_prior import VideoFeatures, VideoPrior
from gvtools.errors import CheckpointError, GvError, ShapeError
from gvtools.networks.compute import hold_in
from gvtools.networks.depth_anything.geometry_head import Geometry
from gvtools.networks.depth_anything.network import DepthAnything3
from gvtools.networks.tensors import first_line

HINTS = "hint encoding"
VIDEO = "video features"
LEVEL1 = "level-1 step"
LEVEL0 = "cascade step"
DECODE = "decoding"
STAGES = (HINTS, VIDEO, LEVEL1, LEVEL0, DECODE)

# Within decoding.
BLOCKS = "encoder blocks"
GEOMETRY = "geometry head"
RGB = "RGB head"
DECODING = (BLOCKS, GEOMETRY, RGB)

Clock = Callable[[str], AbstractContextManager[None]]


def no_clock(stage: str) -> AbstractContextManager[None]:
    """Times nothing."""
    return nullcontext()


@dataclass(frozen=True)
class Prepared:
    """What stays constant over the denoising steps of a pass."""

    batch: ViewBatch  # the views, holes filled where the configuration says so
    hints: Hints  # features of context and projections
    level1: Conditions  # conditions of the level-1 denoiser
    positions: Positions  # its projective transforms
    adapted: list[Tensor] | None = None  # video features at the control branch's width
    # Video features, where keys have to be made of them again for other cameras.
    video: VideoFeatures | None = None
    keys: dict[int, VideoKeys] | None = None  # their keys and values for the coupled blocks


@dataclass(frozen=True)
class Decoded:
    """Pictures and geometry of generated features."""

    rgb: Tensor  # (B, T, 3, H, W) of the target views, not clipped to [0, 1]
    depth: Tensor  # (B, T, H, W) z-depth of the target views, in the model's unit
    depth_confidence: Tensor  # (B, T, H, W) > 1
    # The geometry of all V views; None where the targets' depth alone was decoded.
    all_views: Geometry | None = None

    @property
    def geometry(self) -> Geometry:
        """Of all V views, in the frame of the first view."""
        if self.all_views is None:
            raise ShapeError("the targets' depth alone was decoded, not the geometry of all views")
        return self.all_views


@dataclass(frozen=True)
class Generated:
    """The result of a pass."""

    level1: Tensor  # (B, V, C, h, w) normalised latents
    level0: Tensor  # (B, V, C, h, w) normalised latents
    decoded: Decoded  # pictures and geometry
    # Of the filled projections' own features; None where nothing is composed of it.
    hint: Decoded | None = None


class GeoVerse(nn.Module):
    """The whole model. The encoder, its heads and the video prior are frozen."""

    def __init__(self, config: GeoVerseConfig) -> None:
        super().__init__()
        self.config = config
        channels = config.geometry.encoder.channels
        self.geometry = DepthAnything3(config.geometry)
        self.rgb_head = RGBHead(config.rgb)
        self.level1 = Denoiser(config.level1)
        self.cascade = None if config.cascade is None else Denoiser(config.cascade)
        self.statistics = nn.ModuleList(LatentStatistics(channels) for _ in range(2))
        self.control: ControlBranch | None = None
        self.shared: SharedAttention | None = None
        if config.video is not None and config.injection == "control":
            self.control = ControlBranch(
                config.control, self.level1, video_channels=config.video.channels
            )
        if config.video is not None and config.injection == "shared":
            self.shared = SharedAttention(
                config.shared,
                width=config.level1.width,
                heads=config.level1.heads,
                video_channels=config.video.channels,
            )
        # Used on completions, see ``postprocess.refined``; it stays float32.
        self.refiner = None if config.refiner is None else Refiner(config.refiner)
        # Not a submodule: its weights live in a folder of their own and are never trained.
        self._video: list[VideoPrior] = []
        # True passes the video prior over: its branch is untrained and adds nothing.
        self.without_video = False
        self.freeze()

    def freeze(self) -> None:
        """Turn off gradients of the encoder and both heads; they still pass gradients through."""
        self.geometry.requires_grad_(False)
        self.rgb_head.requires_grad_(False)

    def hold_in(self, dtype: torch.dtype) -> None:
        """Keep the weights in the type that autocast computes in, for inference alone.

        The same results, from half the memory: norms, tokens, tables, frequencies, statistics and
        the geometry head stay float32 (``networks.compute``).
        """
        self.geometry.hold_in(dtype)
        hold_in(dtype, self.rgb_head, self.level1, self.cascade, self.control, self.shared)

    @property
    def level_statistics(self) -> Sequence[LatentStatistics]:
        """Statistics of level 0 and of level 1."""
        return cast("Sequence[LatentStatistics]", self.statistics)

    @property
    def video(self) -> VideoPrior | None:
        """The video prior, when one has been attached."""
        return self._video[0] if self._video else None

    def attach_video(self, prior: VideoPrior) -> None:
        """Use this video prior for the features that the configuration asks for."""
        self._video = [prior]

    def prepare(
        self,
        batch: ViewBatch,  # context views, then targets
        *,
        # Of the video prior's noise; one number, or B rows of V.
        seed: int | Sequence[Sequence[int]] = 0,
        # Features computed before, for the same views; taken from the attached prior when None.
        video: VideoFeatures | None = None,
        clock: Clock = no_clock,  # receives the stages' names
    ) -> Prepared:
        """Everything that the denoising steps share, computed once."""
        config = self.config
        with clock(HINTS):
            source = batch
            batch = filled(batch, config.hints)
            camera = camera_condition(
                torch.linalg.inv(batch.cam_from_world),
                batch.K,
                batch.size,
                context=batch.context,
                reference=config.camera.reference,
                pixel_offset=config.camera.pixel_offset,
            )
            level0, level1 = self.level_statistics
            hints = encode_hints(self.geometry, level0, level1, batch=batch, config=config.hints)
            depth = None
            if config.level1.depth_condition:
                # Filled depth keeps the true validity beside it.
                depth = depth_condition(batch.depth, batch.depth > 0, camera.scale)
                depth = torch.cat((depth[:, :, :1], source.valid.to(depth.dtype)), dim=2)
            conditions = Conditions(hints.level1, camera, depth=depth)
            grid = (hints.level1.shape[-2], hints.level1.shape[-1])
            positions = Positions(config.level1, camera, grid)
            prepared = Prepared(batch, hints, conditions, positions)
        if config.injection == "none" or (self.without_video and video is None):
            return prepared
        with clock(VIDEO):
            features = self._video_features(source, seed) if video is None else video
            return self.with_video(prepared, features)

    @torch.no_grad()
    def clean_latents(self, batch: ViewBatch) -> tuple[Tensor, Tensor]:
        """Level-0 and level-1 latents, (B, V, C, h, w) each, of true pictures of all views."""
        level0, level1 = self.level_statistics
        return encode_latents(self.geometry, level0, level1, batch=batch, config=self.config.hints)

    def with_video(self, prepared: Prepared, features: VideoFeatures) -> Prepared:
        """``prepared`` with video features; gradients reach the adapters."""
        latents = prepared.hints.level1
        grid = (latents.shape[-2], latents.shape[-1])
        if self.control is not None:
            return replace(prepared, adapted=self.control.adapted(features.tensors, grid))
        keys = video_keys(
            self.shared, self.config.level1, prepared.level1.camera, features=features, grid=grid
        )
        return replace(prepared, video=features, keys=keys)

    def _video_features(
        self, batch: ViewBatch, seeds: int | Sequence[Sequence[int]]
    ) -> VideoFeatures:
        if self.video is None:
            raise CheckpointError(
                "this GeoVerse configuration needs the video prior and none was loaded; put the "
                "truncated Wan2.2-VACE folder at video/ (gvtools weights list), or use a "
                "configuration with injection = 'none'"
            )
        return self.video.features(batch.images, batch.valid, batch.context, seed=seeds)

    def velocity1(
        self,
        prepared: Prepared,  # what stays constant
        state: Tensor,  # (B, V, C, h, w)
        t: Tensor,  # (B,) or (B, V)
        *,
        least: float | None = None,  # instead of the configuration's ``flow.least_time``
    ) -> Tensor:
        """The level-1 velocity (Eq. 2)."""
        residuals = None
        if self.control is not None and prepared.adapted is not None:
            residuals = self.control(
                self.level1,
                state,
                t,
                prepared.level1,
                adapted=prepared.adapted,
                positions=prepared.positions,
            )
        out = self.level1(
            state,
            t,
            prepared.level1,
            residuals=residuals,
            video=prepared.keys,
            positions=prepared.positions,
        )
        flow = self.config.flow
        if flow.prediction == "velocity":
            return out
        clean = out + prepared.hints.unmasked if flow.skip else out
        return velocity_from_clean(clean, state, t, least=least or flow.least_time)

    def velocity_wanted(self, velocity: Tensor, t: Tensor) -> Tensor:
        """The target of ``velocity1`` at ``t`` where ``velocity`` (B, V, C, h, w) is right.

        A clean prediction's velocity is divided by no less than ``flow.least_time``; a target that
        is not would have the prediction wrong below it.
        """
        flow = self.config.flow
        if flow.prediction == "velocity":
            return velocity
        return velocity * over_state((t / flow.least_time).clamp(max=1), velocity)

    def cascade_conditions(self, prepared: Prepared, level1: Tensor) -> Conditions:
        """What the cascade knows: clean context level 0, level 1 of all views, cameras (Eq. 3)."""
        return replace(prepared.level1, latents=prepared.hints.level0, source=level1, depth=None)

    def decode(
        self,
        prepared: Prepared,  # of the pass
        level0: Tensor,  # (B, V, C, h, w) normalised latents
        level1: Tensor,  # (B, V, C, h, w) normalised latents
        *,
        # Without all views' geometry; the same pictures and depth, sooner.
        targets_alone: bool = False,
        clock: Clock = no_clock,  # receives the stages' names
    ) -> Decoded:
        """Pictures and depth of the targets, geometry of all views; gradients reach the latents."""
        grid = (level1.shape[-2], level1.shape[-1])
        encoder = self.geometry.encoder
        context = prepared.batch.context
        with clock(BLOCKS):
            pyramid = self.pyramid(level0, level1, prepared.hints.token)
            normed = [encoder.normed(level[:, :, 1:].float()) for level in pyramid]
        targets = [level[:, context:] for level in normed]
        head, together, all_views = self.geometry.head, self.config.decode_views, None
        with clock(GEOMETRY):
            if targets_alone:
                depth, confidence = head.depth(targets, grid, views_at_once=together)
            else:
                all_views = head(normed, grid, views_at_once=together)
                depth, confidence = (
                    value[:, context:] for value in (all_views.depth, all_views.depth_confidence)
                )
        with clock(RGB):
            features = torch.cat(targets, dim=-1)
            shape = features.shape[:2]
            rgb = self.rgb_head(features.flatten(0, 1), grid, chunk=together)
            rgb = rgb.unflatten(0, shape)
        return Decoded(rgb, depth, confidence, all_views)

    def pyramid(self, level0: Tensor, level1: Tensor, token: Tensor) -> list[Tensor]:
        """Four raw (B, V, 1 + N, C) levels of two (B, V, C, h, w) latents and token 0 (B, V, C)."""
        grid = (level1.shape[-2], level1.shape[-1])
        raw = []
        for statistics, latent in zip(self.level_statistics, (level0, level1), strict=True):
            tokens = statistics.denormalise(latent).flatten(3).transpose(2, 3)
            raw.append(torch.cat((token[:, :, None].to(tokens.dtype), tokens), dim=2))
        return [*raw, *self.geometry.encoder.propagate(raw[1], grid)]

    def without_cameras(self, prepared: Prepared, drop: Tensor | None = None) -> Prepared:
        """Without cameras, as GLD's guidance has it, of the samples ``drop`` (B,) or of all."""
        known = prepared.level1.camera
        camera = known.unconditional()
        if drop is not None:
            at = drop[:, None, None, None]
            camera = replace(
                camera,
                map=torch.where(at[..., None], camera.map, known.map),
                cam_from_world=torch.where(at, camera.cam_from_world, known.cam_from_world),
                K=torch.where(at, camera.K, known.K),
            )
        grid = (prepared.hints.level1.shape[-2], prepared.hints.level1.shape[-1])
        video = prepared.video
        return replace(
            prepared,
            level1=replace(prepared.level1, camera=camera),
            positions=Positions(self.config.level1, camera, grid),
            keys=None
            if video is None
            else video_keys(self.shared, self.config.level1, camera, features=video, grid=grid),
        )

    def sample1(
        self,
        prepared: Prepared,  # what stays constant
        noise: Tensor,  # (B, V, C, h, w)
        *,
        bounds: Sequence[float] | None = None,  # see ``generate``, as the others
        cfg_scale: float | None = None,  # of classifier-free guidance over the cameras
        temperature: float | None = None,  # of the noise
        clock: Clock = no_clock,  # receives the stages' names
    ) -> Tensor:
        """Level-1 latents from (B, V, C, h, w) noise, one Euler step an interval."""
        flow = self.config.flow
        noise = noise * (flow.temperature if temperature is None else temperature)
        scale = flow.cfg_scale if cfg_scale is None else cfg_scale
        without = self.without_cameras(prepared) if scale != 1 else prepared
        tau = check_bounds(bounds or flow.level1)
        # The floor is for training. A step from t goes (t - next) / t of the way to the clean
        # latents, however small t is; with the floor, short last steps would leave noise behind.
        least = min(flow.least_time, tau[-2])

        def velocity(state: Tensor, t: Tensor) -> Tensor:
            with clock(LEVEL1):
                return self.velocity1(prepared, state, t, least=least)

        def unconditional(state: Tensor, t: Tensor) -> Tensor:
            with clock(LEVEL1):
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
            with clock(LEVEL0):
                return cascade(state, t, conditions, positions=positions)

        flow = self.config.flow
        scale = flow.cascade_cfg_scale if cfg_scale is None else cfg_scale
        if scale == 1:
            return sample(velocity, noise, bounds or flow.cascade)
        # As GLD's evaluation runs its cascade: poses are dropped, intrinsics kept.
        without = replace(conditions, camera=conditions.camera.unconditional("old"))
        elsewhere = Positions(cascade.config, without.camera, grid)

        def unconditional(state: Tensor, t: Tensor) -> Tensor:
            with clock(LEVEL0):
                return cascade(state, t, without, positions=elsewhere)

        return sample(
            velocity, noise, bounds or flow.cascade, unconditional=unconditional, cfg_scale=scale
        )

    @torch.no_grad()
    def generate(
        self,
        batch: ViewBatch,  # context views, then targets
        *,
        seed: int = 0,  # of all noise
        # B rows of V names; a view's noise depends on the seed and its name alone. Its index by
        # default.
        names: Sequence[Sequence[int | str]] | None = None,
        # Level-1 interval bounds; the configuration's by default. Empty: nothing is denoised, and
        # the hints' own features stand for level 1.
        bounds: Sequence[float] | None = None,
        # Level-0 interval bounds; the configuration's by default.
        cascade_bounds: Sequence[float] | None = None,
        # Of classifier-free guidance; the configuration's by default.
        cfg_scale: float | None = None,
        cascade_cfg_scale: float | None = None,  # likewise, of level 0
        temperature: float | None = None,  # of level 1; the configuration's by default
        video: VideoFeatures | None = None,  # features computed before, for the same views
        # Without all views' geometry; the same pictures and depth, sooner.
        targets_alone: bool = False,
        clock: Clock = no_clock,  # receives the stages' names
    ) -> Generated:
        """One pass: prepare, sample level 1 and level 0, decode."""
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
        with clock(DECODE):
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
