"""FLOPs of a pass, counted on the meta device: the real code on tensors without numbers.

A multiplication and an addition count as two. Products, convolutions and attention are counted;
what is done to single numbers (norms, activations, gates) is not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from gvtools.completers.geoverse.conditioning import Hints, ViewBatch, encode_hints
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.denoiser import Conditions, Positions
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.passes import Prepared
from gvtools.completers.geoverse.plucker import CameraCondition
from gvtools.completers.geoverse.stages import DECODE, HINTS, LEVEL0, LEVEL1, VIDEO
from gvtools.completers.geoverse.statistics import LatentStatistics
from gvtools.completers.geoverse.video_prior.prior import VideoFeatures
from gvtools.errors import CheckpointError
from gvtools.networks.depth_anything.network import DepthAnything3
from pipelines.bench.random_model import random_features, random_model, random_video
from pipelines.bench.stage_clock import StageClock

# Classes whose share within a stage is of interest, and what a reader calls them.
WITHIN = {
    "ControlBranch": "control branch",
    "WanEncoder3d": "video VAE",
    "WanVACETransformer3DModel": "video transformer",
}


@dataclass(frozen=True)
class PassFlops:
    """What a pass costs.

    Attributes:
        rows: FLOPs by row of the stage table.
        within: FLOPs of single networks, in the whole pass.
        parameters: numbers by part of the model, the video prior's included.
        video: why the video prior is not in the figures; None where it is, or where there is none.
    """

    rows: dict[str, float]
    within: dict[str, float]
    parameters: dict[str, int]
    video: str | None = None


def flops(call: Callable[[], object]) -> int:
    """FLOPs of a call whose tensors are on the meta device."""
    with _autocast_on_meta(), FlopCounterMode(display=False) as counter, torch.no_grad():
        call()
    return int(counter.get_total_flops())


def pass_flops(
    config: GeoVerseConfig,
    batch: ViewBatch,
    *,
    bounds: Sequence[float],
    cascade_bounds: Sequence[float],
    video: bool = True,
) -> PassFlops:
    """Run a pass on the meta device.

    Args:
        config: of the model.
        batch: the views; which of them know something decides what is encoded.
        bounds: of the level-1 steps.
        cascade_bounds: of the cascade's.
        video: count the video prior, with the published network's sizes.
    """
    model = random_model(config, "meta")
    absent = None
    if config.video is not None and video:
        try:
            model.attach_video(random_video(config.video, "meta"))
        except CheckpointError as error:
            absent = str(error)
    with _autocast_on_meta(), FlopCounterMode(display=False) as counter, torch.no_grad():
        clock = StageClock(counter.get_total_flops)
        with clock(HINTS):
            hints = _hints(config, batch)
        prepared = _prepared(config, batch, hints)
        if config.injection != "none":
            with clock(VIDEO):
                prepared = model.with_video(prepared, _video_features(model, prepared.batch))
        noise = prepared.hints.level1
        level1 = model.sample1(prepared, noise, bounds=bounds, clock=clock)
        level0 = model.sample0(prepared, level1, noise, bounds=cascade_bounds, clock=clock)
        with clock(DECODE):
            model.decode(prepared, level0, level1, clock=clock)
    counts = counter.get_flop_counts()
    within = {
        place: float(sum(counts[kind].values())) for kind, place in WITHIN.items() if kind in counts
    }
    steps = {LEVEL1: len(bounds) - 1, LEVEL0: len(cascade_bounds) - 1}
    return PassFlops(clock.rows(steps), within, parameters(model), absent)


def parameters(model: GeoVerse) -> dict[str, int]:
    """Numbers by part, buffers not counted."""
    geometry = model.geometry
    parts: dict[str, Sequence[Any]] = {
        "encoder": (geometry.backbone,),
        "geometry head": (geometry.head,),
        "camera encoder and decoder": (geometry.cam_enc, geometry.cam_dec),
        "RGB head": (model.rgb_head,),
        "level-1 denoiser": (model.level1,),
        "cascade": (model.cascade,),
        "control branch": (model.control,),
        "shared attention": (model.shared,),
    }
    if model.video is not None:
        networks = model.video.networks
        parts |= {"video transformer": (networks.transformer,), "video VAE": (networks.vae,)}
    counts = {
        name: sum(p.numel() for part in group if part is not None for p in part.parameters())
        for name, group in parts.items()
    }
    counts = {name: count for name, count in counts.items() if count}
    return counts | {"total": sum(counts.values())}


class _Encoder(DepthAnything3):
    """Counted on the meta device, for a caller who decides by numbers what is to be encoded."""

    def encode(
        self,
        images: Tensor,
        *,
        levels: int | None = None,
        cam_from_world: Tensor | None = None,
        K: Tensor | None = None,
    ) -> list[Tensor]:
        """Zeros on the caller's device."""
        cameras = (None if x is None else x.to("meta") for x in (cam_from_world, K))
        pose, intrinsics = cameras
        found = super().encode(images.to("meta"), levels=levels, cam_from_world=pose, K=intrinsics)
        return [torch.zeros_like(level, device=images.device) for level in found]


def _hints(config: GeoVerseConfig, batch: ViewBatch) -> Hints:
    """Zeros of the hints' shapes; filling holes costs no FLOPs."""
    with torch.device("meta"):
        encoder = _Encoder(config.geometry)
    channels = config.geometry.encoder.channels
    statistics = LatentStatistics(channels), LatentStatistics(channels)
    return encode_hints(encoder, *statistics, batch=batch, config=config.hints)


def _prepared(config: GeoVerseConfig, batch: ViewBatch, hints: Hints) -> Prepared:
    """What the denoising steps share, on the meta device."""
    batch, views = batch.to("meta"), batch.images.shape[1]
    tensors = (hints.level1, hints.unmasked, hints.level0, hints.token, hints.mask)
    hints = Hints(*(tensor.to("meta") for tensor in tensors))
    camera = CameraCondition(
        map=torch.empty(1, views, 7, *batch.size, device="meta"),
        cam_from_world=batch.cam_from_world,
        K=batch.K,
        size=batch.size,
        scale=torch.empty(1, device="meta"),
        context=batch.context,
    )
    depth = None
    if config.level1.depth_condition:
        depth = torch.empty(1, views, 2, *batch.size, device="meta")
    grid = (hints.level1.shape[-2], hints.level1.shape[-1])
    positions = Positions(config.level1, camera, grid)
    return Prepared(batch, hints, Conditions(hints.level1, camera, depth=depth), positions)


def _video_features(model: GeoVerse, batch: ViewBatch) -> VideoFeatures:
    """Of the model's video prior; without one, as it would give them."""
    if model.video is not None:
        return model.video.features(batch.images, batch.valid, batch.context)
    features = random_features(model.config, batch)
    if features is None:
        raise CheckpointError("no video prior in this configuration")
    return features


@contextmanager
def _autocast_on_meta() -> Iterator[None]:
    """Let ``torch.autocast`` pass over the meta device, which it refuses: nothing is cast there."""
    kept = torch.autocast

    def autocast(device_type: str, *args: Any, **options: Any) -> Any:
        if device_type == "meta":
            return nullcontext()
        return kept(device_type, *args, **options)

    torch.autocast = autocast  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        torch.autocast = kept  # type: ignore[misc]
