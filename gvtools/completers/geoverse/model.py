"""GeoVerse: the whole model, from views and projections to target pictures, depth and rays.

Data flow of one pass (tensor shapes in the README.md beside this file; equations are the paper's)::

    pictures, projections --fill_holes--> encode_hints (Eq. 1) --> hints
    hints, cameras, depth --> Conditions;  video prior --> control residuals | shared keys (once)
    noise --level-1 denoiser (Eq. 2), K Euler steps--> level 1 --cascade (Eq. 3)--> level 0
    level 1 --frozen blocks--> levels 2, 3;  all four --heads--> pictures, depth, rays
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.camera_encoding import CameraCondition, camera_condition
from gvtools.completers.geoverse.conditioning import (
    Hints,
    LatentStatistics,
    ViewBatch,
    depth_condition,
    encode_hints,
    encode_views,
    fill_holes,
    maps,
)
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.denoiser import (
    Conditions,
    Denoiser,
    Encoding,
    Positions,
    VideoKeys,
)
from gvtools.completers.geoverse.flow import (
    check_bounds,
    drawn_noise,
    guide,
    over_state,
    sample,
    velocity_from_clean,
    view_seed,
)
from gvtools.completers.geoverse.refiner import Refiner
from gvtools.completers.geoverse.rgb_head import RGBHead
from gvtools.completers.geoverse.video_injection import ControlBranch, SharedAttention
from gvtools.completers.geoverse.video_prior import VideoFeatures, VideoPrior
from gvtools.errors import CheckpointError, GvError
from gvtools.networks.compute import hold_in, on_device
from gvtools.networks.depth_anything.geometry_head import ViewGeometry
from gvtools.networks.depth_anything.network import DepthAnything3
from gvtools.networks.tensors import first_line, shapes_alone

# Stages of a pass, which a model's ``clock`` is called with.
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

    batch: ViewBatch  # holes filled where the configuration says so
    hints: Hints
    level1: Conditions  # of the level-1 denoiser
    positions: Positions  # its projective transforms
    adapted: list[Tensor] | None = None  # video features at the control branch's width
    # Video features, where keys have to be made of them again for other cameras.
    video: VideoFeatures | None = None
    keys: dict[int, VideoKeys] | None = None  # and values, for the coupled blocks

    @property
    def grid(self) -> tuple[int, int]:
        """Tokens of a view, (h, w)."""
        return self.hints.level1.shape[-2], self.hints.level1.shape[-1]


@dataclass(frozen=True)
class Decoded:
    """Pictures and geometry of generated features."""

    rgb: Tensor  # (B, T, 3, H, W) of the target views, not clipped to [0, 1]
    depth: Tensor  # (B, T, H, W) z-depth of the target views, in the model's unit
    depth_confidence: Tensor  # (B, T, H, W) > 1
    # The geometry of all V views; None where the targets' depth alone was decoded.
    all_views: ViewGeometry | None = None

    @property
    def geometry(self) -> ViewGeometry:
        """Of all V views, in the frame of the first view."""
        assert self.all_views is not None
        return self.all_views


@dataclass(frozen=True)
class Generated:
    """The result of a pass."""

    level1: Tensor  # (B, V, C, h, w) normalised latents
    level0: Tensor  # (B, V, C, h, w) normalised latents
    decoded: Decoded
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
                config.shared, config.level1, video_channels=config.video.channels
            )
        # Used on completions, see ``composition.refine``; it stays float32.
        self.refiner = None if config.refiner is None else Refiner(config.refiner)
        # Not a submodule: its weights live in a folder of their own and are never trained.
        self._video: list[VideoPrior] = []
        # True passes the video prior over: its branch is untrained and adds nothing.
        self.without_video = False
        # A benchmark puts in its own.
        self.clock: Clock = no_clock
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

    def compile_blocks(self) -> None:
        """Compile the repeated blocks on first use: one of a kind stands for all of them."""
        parts = [self.level1, self.cascade, self.control, self.rgb_head]
        parts += [] if self.video is None else [self.video.networks.transformer]
        for part in parts:
            for blocks in () if part is None else part.children():
                if isinstance(blocks, nn.ModuleList):
                    for block in blocks:
                        block.compile(dynamic=False)

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

    @torch.no_grad()
    def generate(
        self,
        batch: ViewBatch,
        *,
        seed: int = 0,
        # B rows of V: a view's noise depends on the seed and its name, by default its index, alone.
        names: Sequence[Sequence[int | str]] | None = None,
        # Of level 1. Empty: nothing is denoised, the hints' own features stand for level 1.
        bounds: Sequence[float] | None = None,
        cascade_bounds: Sequence[float] | None = None,
        cfg_scale: float | None = None,
        cascade_cfg_scale: float | None = None,
        temperature: float | None = None,
        encoder_interval: float = 0.0,  # see ``Encoding``
        video: VideoFeatures | None = None,  # computed before, for the same views
        targets_alone: bool = False,  # see ``decode``
    ) -> Generated:
        """One pass: prepare, sample level 1 and level 0, decode.

        How it samples is the configuration's (``FlowConfig``) where None.
        """
        rows = names or [list(range(batch.images.shape[1]))] * len(batch.images)

        def seeds(draw: str) -> list[list[int]]:
            return [[view_seed(seed, draw, name) for name in row] for row in rows]

        encoder = self.config.geometry.encoder
        grid = self.geometry.encoder.grid(*batch.size)
        shape = (*batch.images.shape[:2], encoder.channels, *grid)
        denoises = bounds is None or len(bounds) > 0
        # Drawn on the CPU, while the device prepares.
        with ThreadPoolExecutor(1) as aside:
            draws = {
                level: aside.submit(drawn_noise, shape, seeds(level))
                for level in (("level1", "level0") if denoises else ("level0",))
            }

            def noise(level: str) -> Tensor:
                return on_device(draws[level].result(), batch.images.device)

            prepared = self.prepare(batch, seed=seeds("video"), video=video)
            level1 = prepared.hints.unmasked
            if denoises:
                level1 = self.sample1(
                    prepared,
                    noise("level1"),
                    bounds=bounds,
                    cfg_scale=cfg_scale,
                    temperature=temperature,
                    encoder_interval=encoder_interval,
                )
            level0 = self.sample0(
                prepared,
                level1,
                noise("level0"),
                bounds=cascade_bounds,
                cfg_scale=cascade_cfg_scale,
                encoder_interval=encoder_interval,
            )
        hint = None
        with self.clock(DECODE):
            decoded = self.decode(prepared, level0, level1, targets_alone=targets_alone)
            if self.config.composition == "correction":
                hint = self.decode(prepared, level0, prepared.hints.unmasked, targets_alone=True)
        return Generated(level1, level0, decoded, hint)

    def prepare(
        self,
        batch: ViewBatch,
        *,
        # Of the video prior's noise; one number, or B rows of V.
        seed: int | Sequence[Sequence[int]] = 0,
        video: VideoFeatures | None = None,  # of the attached prior when None
    ) -> Prepared:
        """Everything that the denoising steps share, computed once: Eq. 1, cameras, video."""
        prepared = self.encoded(batch)
        if video is None:
            video = self.video_features(batch, seed=seed)
        return self.with_video(prepared, video)

    def encoded(self, batch: ViewBatch) -> Prepared:
        """What does not come from the video prior."""
        config = self.config
        with self.clock(HINTS):
            source = batch
            batch = fill_holes(batch, config.hints)
            camera = camera_condition(
                torch.linalg.inv_ex(batch.cam_from_world).inverse,
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
            return Prepared(batch, hints, conditions, Positions(config.level1, camera, grid))

    def video_features(
        self, batch: ViewBatch, *, seed: int | Sequence[Sequence[int]] = 0
    ) -> VideoFeatures | None:
        """Of the frozen prior; None where nothing takes them."""
        if self.config.injection == "none" or self.without_video:
            return None
        if self.video is None:
            raise CheckpointError(
                "this GeoVerse configuration needs the video prior and none was loaded; put the "
                "truncated Wan2.2-VACE folder at video/ (gvtools weights list), or use a "
                "configuration with injection = 'none'"
            )
        with self.clock(VIDEO):
            return self.video.features(batch.images, batch.valid, batch.context, seed=seed)

    def with_video(self, prepared: Prepared, features: VideoFeatures | None) -> Prepared:
        """``prepared`` with video features; gradients reach the adapters."""
        if features is None or self.config.injection == "none":
            return prepared
        with self.clock(VIDEO):
            if self.control is not None:
                adapted = self.control.adapted(features, prepared.grid)
                return replace(prepared, adapted=adapted)
            keys = self._keys(features, prepared.level1.camera, prepared.grid)
            return replace(prepared, video=features, keys=keys)

    def _keys(
        self, video: VideoFeatures | None, camera: CameraCondition, grid: tuple[int, int]
    ) -> dict[int, VideoKeys] | None:
        if video is None or self.shared is None:
            return None
        keys: dict[int, VideoKeys] = self.shared(video, camera, grid)
        return keys

    def velocity1(
        self,
        prepared: Prepared,
        state: Tensor,  # (B, V, C, h, w)
        t: Tensor,  # (B,) or (B, V)
        *,
        least: float | None = None,  # instead of the configuration's ``flow.least_time``
        encoding: Encoding | None = None,  # of a pass whose steps share the encoder's tokens
    ) -> Tensor:
        """The level-1 velocity (Eq. 2), with the control branch's residuals (Eqs. 5 and 6)."""
        known, positions, residuals = prepared.level1, prepared.positions, None
        encodes = encoding is None or encoding.tokens is None
        if encodes and self.control is not None and prepared.adapted is not None:
            residuals = self.control(
                self.level1, state, t, known, adapted=prepared.adapted, positions=positions
            )
        out = self.level1(
            state, t, known, residuals=residuals, video=prepared.keys, positions=positions,
            encoding=encoding,
        )  # fmt: skip
        flow = self.config.flow
        if flow.prediction == "velocity":
            return out
        clean = out + prepared.hints.unmasked if flow.skip else out
        return velocity_from_clean(clean, state, t, least=least or flow.least_time)

    def sample1(
        self,
        prepared: Prepared,
        noise: Tensor,  # (B, V, C, h, w)
        *,
        bounds: Sequence[float] | None = None,
        cfg_scale: float | None = None,
        temperature: float | None = None,
        encoder_interval: float = 0.0,
    ) -> Tensor:
        """Level-1 latents of noise, one Euler step an interval; see ``generate``."""
        flow = self.config.flow
        noise = noise * (flow.temperature if temperature is None else temperature)
        scale = flow.cfg_scale if cfg_scale is None else cfg_scale
        tau = check_bounds(bounds or flow.level1)
        # The floor is for training. A step from t goes (t - next) / t of the way to the clean
        # latents, however small t is; with the floor, short last steps would leave noise behind.
        least = min(flow.least_time, tau[-2])
        known = prepared if scale == 1 else self.without_and_with_cameras(prepared)
        encoding = Encoding(tau, encoder_interval)

        def velocity(state: Tensor, t: Tensor) -> Tensor:
            encoding.begin_step()
            with self.clock(LEVEL1):
                return self.velocity1(known, state, t, least=least, encoding=encoding)

        return sample(guide(velocity, scale), noise, tau)

    def sample0(
        self,
        prepared: Prepared,
        level1: Tensor,  # (B, V, C, h, w)
        noise: Tensor,  # (B, V, C, h, w)
        *,
        bounds: Sequence[float] | None = None,
        cfg_scale: float | None = None,
        encoder_interval: float = 0.0,
    ) -> Tensor:
        """Level-0 latents of level-1 latents (Eq. 3); the mean without a cascade."""
        if self.cascade is None:
            return torch.zeros_like(level1)
        cascade, flow = self.cascade, self.config.flow

        known = self.cascade_conditions(prepared, level1)
        scale = flow.cascade_cfg_scale if cfg_scale is None else cfg_scale
        if scale != 1:
            # As GLD's evaluation runs its cascade: poses are dropped, intrinsics kept.
            known = joined(replace(known, camera=known.camera.unconditional("old")), known)
        positions = Positions(cascade.config, known.camera, prepared.grid)
        tau = bounds or flow.cascade
        encoding = Encoding(tau, encoder_interval)

        def velocity(state: Tensor, t: Tensor) -> Tensor:
            encoding.begin_step()
            with self.clock(LEVEL0):
                return cascade(state, t, known, positions=positions, encoding=encoding)

        return sample(guide(velocity, scale), noise, tau)

    def cascade_conditions(self, prepared: Prepared, level1: Tensor) -> Conditions:
        """Clean context level 0, level 1 of all views, cameras: the conditions of Eq. 3."""
        return replace(prepared.level1, latents=prepared.hints.level0, source=level1, depth=None)

    def pyramid(self, level0: Tensor, level1: Tensor, token: Tensor) -> list[Tensor]:
        """Four raw (B, V, 1 + N, C) levels of two (B, V, C, h, w) latents and token 0 (B, V, C)."""
        grid = (level1.shape[-2], level1.shape[-1])
        raw = []
        for statistics, latent in zip(self.level_statistics, (level0, level1), strict=True):
            tokens = statistics.denormalise(latent).flatten(3).transpose(2, 3)
            raw.append(torch.cat((token[:, :, None].to(tokens.dtype), tokens), dim=2))
        return [*raw, *self.geometry.encoder.propagate(raw[1], grid)]

    def decode(
        self,
        prepared: Prepared,
        level0: Tensor,  # (B, V, C, h, w) normalised latents
        level1: Tensor,  # (B, V, C, h, w) normalised latents
        *,
        targets_alone: bool = False,  # without all views' geometry: the same, sooner
    ) -> Decoded:
        """Pictures and depth of the targets, geometry of all views; gradients reach the latents."""
        grid, context, all_views = prepared.grid, prepared.batch.context, None
        head, together = self.geometry.head, self.config.decode_views
        with self.clock(BLOCKS):
            pyramid = self.pyramid(level0, level1, prepared.hints.token)
            normed = [self.geometry.encoder.normed(level[:, :, 1:].float()) for level in pyramid]
        targets = [level[:, context:] for level in normed]
        with self.clock(GEOMETRY):
            if targets_alone:
                depth, confidence = head.depth(targets, grid, views_at_once=together)
            else:
                all_views = head(normed, grid, views_at_once=together)
                depth, confidence = (
                    value[:, context:] for value in (all_views.depth, all_views.depth_confidence)
                )
        with self.clock(RGB):
            features = torch.cat(targets, dim=-1)
            rgb = self.rgb_head(features.flatten(0, 1), grid, chunk=together)
            rgb = rgb.unflatten(0, features.shape[:2])
        return Decoded(rgb, depth, confidence, all_views)

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
        return replace(
            prepared,
            level1=replace(prepared.level1, camera=camera),
            positions=Positions(self.config.level1, camera, prepared.grid),
            keys=self._keys(prepared.video, camera, prepared.grid),
        )

    def without_and_with_cameras(self, prepared: Prepared) -> Prepared:
        """Every sample twice in a batch, for ``velocity1`` under ``guide``."""
        twice: Prepared = joined(self.without_cameras(prepared), prepared)
        positions = Positions(self.config.level1, twice.level1.camera, prepared.grid)
        return replace(twice, positions=positions)

    @torch.no_grad()
    def clean_latents(self, batch: ViewBatch) -> tuple[Tensor, Tensor]:
        """Level-0 and level-1 latents, (B, V, C, h, w) each, of true pictures of all views."""
        grid = self.geometry.encoder.grid(*batch.size)
        both = encode_views(self.geometry, batch, slice(None), config=self.config.hints)
        level0, level1 = self.level_statistics
        return level0.normalise(maps(both[0], grid)), level1.normalise(maps(both[1], grid))

    @torch.no_grad()
    def reconstruct(self, picture: Tensor) -> Tensor:
        """(1, 3, H, W) in [0, 1], encoded and decoded without a denoiser; H and W whole patches."""
        images = picture[:, None].expand(-1, 2, -1, -1, -1)
        size = max(picture.shape[-2:])
        K = picture.new_tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]])
        nothing = torch.zeros_like(images[:, :, :1])
        pose = torch.eye(4, device=picture.device).expand(1, 2, 4, 4)
        batch = ViewBatch(images, nothing, nothing == 0, pose, K.expand(1, 2, 3, 3), 1)
        return self.decode(self.encoded(batch), *self.clean_latents(batch), targets_alone=True).rgb[
            :, 0
        ]

    def velocity_wanted(self, velocity: Tensor, t: Tensor) -> Tensor:
        """The target of ``velocity1`` at ``t`` where ``velocity`` (B, V, C, h, w) is right.

        A clean prediction's velocity is divided by no less than ``flow.least_time``; a target that
        is not would have the prediction wrong below it.
        """
        flow = self.config.flow
        if flow.prediction == "velocity":
            return velocity
        return velocity * over_state((t / flow.least_time).clamp(max=1), velocity)


def joined(first: Any, second: Any) -> Any:
    """One batch of two, in whatever holds tensors (B, ...)."""
    if isinstance(first, Tensor) and first.ndim:
        return torch.cat((first, second))
    if isinstance(first, (list, tuple)):
        return type(first)(map(joined, first, second))
    if isinstance(first, dict):
        return {key: joined(value, second[key]) for key, value in first.items()}
    if is_dataclass(first):
        return replace(first, **joined(vars(first), vars(second)))  # type: ignore[type-var]
    return first


def empty_model(config: GeoVerseConfig, *, where: object) -> GeoVerse:
    """The model on the meta device: names and shapes, no numbers, no memory."""
    try:
        with shapes_alone():
            return GeoVerse(config)
    except GvError:
        raise
    except Exception as error:
        # Dimensions that do not divide, that are negative or zero: each module has its own way.
        raise CheckpointError(
            f"{where}: no network comes of configuration {config.name!r} ({first_line(error)}); "
            "expected dimensions that fit each other, such as those of base or tiny"
        ) from error
