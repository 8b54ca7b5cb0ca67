"""Pictures, projections and cameras as the denoisers are conditioned on them.

Features of the frozen encoder become latents by mean and variance of each channel, as in Geometric
Latent Diffusion: the channels are heavy-tailed (Depth Anything 3 Base, level 1: deviations from
0.14 to 10). The hint features are Eq. 1 of the paper: context pictures and projections are encoded
jointly and masked by the validity at feature resolution. The mask is applied to *normalised*
features, so that a target without a valid token has exactly GLD's zero padding; such a view is also
left out of the joint encoding, since its black picture would disturb the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gvtools.completers.geoverse.camera_encoding import normalised_poses
from gvtools.completers.push_pull import push_pull, push_pull_depth
from gvtools.networks.config_json import check_range
from gvtools.networks.depth_anything.network import DepthAnything3, relative_cameras

LOG_DEPTH_LIMIT = 6.0


class LatentStatistics(nn.Module):
    """Mean and variance of the channels of one feature level; ``eps`` is added to the variance."""

    mean: Tensor
    var: Tensor

    def __init__(self, channels: int, *, eps: float = 1e-5) -> None:
        super().__init__()
        self.eps = eps
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("var", torch.ones(channels))

    def normalise(self, raw: Tensor) -> Tensor:
        """Raw features (..., C, h, w) to latents."""
        mean, std = self._shaped(raw)
        return (raw - mean) / std

    def denormalise(self, latent: Tensor) -> Tensor:
        """The inverse of ``normalise``."""
        mean, std = self._shaped(latent)
        return latent * std + mean

    def _shaped(self, like: Tensor) -> tuple[Tensor, Tensor]:
        std = (self.var + self.eps).sqrt()
        return self.mean.to(like.dtype)[:, None, None], std.to(like.dtype)[:, None, None]


@dataclass(frozen=True)
class HintConfig:
    """How projections become features; the defaults are the paper's form."""

    # "none": holes are black; "push-pull": they are filled before encoding; "surfaces": likewise,
    # and callers fill what they can along surfaces first (``surface_fill``).
    fill: Literal["none", "push-pull", "surfaces"] = "none"
    # "jointly": context and projections in one pass (Eq. 1); "alone": the context views by
    # themselves, and the projections with them in a second pass; "context": the context views by
    # themselves and no projections, as GLD does.
    encode: Literal["jointly", "alone", "context"] = "jointly"
    # Features of a token count where at least this share of its pixels is valid; 0: the features
    # are not masked (of use with filled holes).
    mask: float = 0.5
    cameras: bool = False  # known cameras go into the encoder's camera tokens
    # Of those cameras: "median", the median distance of the centres from the first (DA3); or
    # "depth", the mean known depth of the context, where any is known.
    camera_unit: Literal["median", "depth"] = "median"
    # Level-0 features of the context come from the context "alone" (as GLD trains its cascade) or
    # from the "jointly" encoded sequence.
    cascade_context: Literal["alone", "jointly"] = "alone"
    # Token 0 of generated features: "first-context" encoded alone and shared by all views (GLD), or
    # each view's "own" of the joint encoding.
    token: Literal["first-context", "own"] = "first-context"

    def __post_init__(self) -> None:
        check_range("hints.mask", self.mask, ge=0, le=1)


@dataclass(frozen=True)
class ViewBatch:
    """Context views, then target views, all of one size."""

    # (B, V, 3, H, W) in [0, 1]: context pictures; projections on targets, holes at 0.
    images: Tensor
    # (B, V, 1, H, W) z-depth in the unit of the sample's cameras; 0 = none. A hole of a projection
    # that has depth was filled by the caller, its picture too.
    depth: Tensor
    valid: Tensor  # (B, V, 1, H, W) bool: True on context; True where the projection knows a target
    cam_from_world: Tensor  # (B, V, 4, 4)
    K: Tensor  # (B, V, 3, 3), px of ``images``, pixel centres at + 0.5
    context: int  # number of context views, at least one
    # (B, V, 2, H, W) what the caller's fill of holes rests on: the confidence of its depth, and the
    # weight of the photographs that its colour was seen in, in [0, 1]; None without such a fill.
    evidence: Tensor | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.images.shape[-2], self.images.shape[-1]

    def to(self, device: torch.device | str) -> ViewBatch:
        """On another device."""
        return self._each(lambda tensor: tensor.to(device))

    def samples(self, index: Tensor) -> ViewBatch:
        """Some samples of the batch."""
        return self._each(lambda tensor: tensor[index])

    def _each(self, change: Callable[[Tensor], Tensor]) -> ViewBatch:
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        changed: dict[str, Any] = {name: change(value) for name, value in tensors.items()}
        return replace(self, **changed)


@dataclass(frozen=True)
class Hints:
    """Features of context and projections."""

    level1: Tensor  # (B, V, C, h, w) normalised and masked: what the denoiser is conditioned on
    unmasked: Tensor  # (B, V, C, h, w) normalised: where a hint skip starts from
    level0: Tensor  # (B, V, C, h, w) normalised on context views, zeros on targets
    token: Tensor  # (B, V, C) raw token 0 of level 1, for ``Backbone.propagate``
    mask: Tensor  # (B, V, 1, h, w) in {0, 1}


def feature_mask(valid: Tensor, grid: tuple[int, int], share: float) -> Tensor:
    """(B, V, 1, h, w) in {0, 1}: a ``share`` of a token's pixels is valid; 0 counts all."""
    patch = (valid.shape[-2] // grid[0], valid.shape[-1] // grid[1])
    covered = F.avg_pool2d(valid.float().flatten(0, 1), patch).unflatten(0, valid.shape[:2])
    # The mean of a patch is rounded; half of an even number of pixels must still count as half.
    return (covered >= share - 1e-6).to(torch.float32)


def depth_condition(depth: Tensor, valid: Tensor, scale: Tensor) -> Tensor:
    """(B, V, 2, H, W): log of the depth in the cameras' unit where valid, and the validity.

    ``depth`` and ``valid`` are (B, V, 1, H, W), ``scale`` (B,) the camera condition's.
    """
    known = (valid > 0) & (depth > 0) & torch.isfinite(depth)
    unit = torch.where(known, depth, torch.ones_like(depth)) * scale[:, None, None, None, None]
    log = unit.clamp_min(torch.finfo(unit.dtype).tiny).log()
    log = log.clamp(-LOG_DEPTH_LIMIT, LOG_DEPTH_LIMIT) * known
    return torch.cat((log, known.to(log.dtype)), dim=2)


def fill_holes(batch: ViewBatch, config: HintConfig) -> ViewBatch:
    """The batch with its holes filled as ``config.fill`` says; what has depth is kept."""
    if config.fill == "none":
        return batch
    flat = (batch.valid | (batch.depth > 0)).flatten(0, 1)
    shape = batch.images.shape[:2]
    images = push_pull(batch.images.flatten(0, 1), flat).unflatten(0, shape)
    depth = push_pull_depth(batch.depth.flatten(0, 1), flat).unflatten(0, shape)
    return replace(batch, images=images, depth=depth)


@torch.no_grad()
def encode_hints(
    network: DepthAnything3,
    level0: LatentStatistics,
    level1: LatentStatistics,
    *,
    batch: ViewBatch,  # its holes filled already where they should be (``fill_holes``)
    config: HintConfig,
) -> Hints:
    """Eq. 1 for every sample of a batch (see the module)."""
    grid, context = network.encoder.grid(*batch.size), batch.context
    mask = feature_mask(batch.valid, grid, config.mask)
    mask[:, :context] = 1
    # With a share of 0 all tokens count, but a view without a valid pixel still tells nothing.
    informative = mask.flatten(2).any(2) & batch.valid.flatten(2).any(2)
    if config.encode == "context":
        mask[:, context:], informative[:, context:] = 0, False
    informative[:, :context] = True
    # Only where it is asked for: with everything encoded jointly it is not.
    alone = cache(lambda: encode_views(network, batch, slice(0, context), config=config))
    joint = _encode_jointly(network, batch, informative, config=config, alone=alone)
    if config.encode == "alone":
        for level, features in zip(joint, alone(), strict=True):
            level[:, :context] = features
    token = joint[1][:, :, 0]
    if config.token == "own":
        # A view that was not encoded gets the mean of the context's.
        mean = token[:, :context].mean(1, keepdim=True)
        token = torch.where(informative[:, :, None], token, mean)
    else:
        one = slice(0, 1)
        first = alone() if context == 1 else encode_views(network, batch, one, config=config)
        token = first[1][:, :, 0].expand_as(token)

    features = level1.normalise(maps(joint[1], grid)) * informative[:, :, None, None, None]
    source = alone()[0] if config.cascade_context == "alone" else joint[0][:, :context]
    shallow = torch.zeros_like(features)
    shallow[:, :context] = level0.normalise(maps(source, grid))
    return Hints(features * mask.to(features.dtype), features, shallow, token, mask)


def _encode_jointly(
    network: DepthAnything3,
    batch: ViewBatch,  # all views
    informative: Tensor,  # which views are encoded; samples that agree in it share a pass
    *,
    config: HintConfig,
    alone: Callable[[], list[Tensor]],  # the context's levels where nothing else is encoded
) -> list[Tensor]:
    """Raw levels 0 and 1, token 0 included, of the ``informative`` (B, V) views; else 0."""
    rows, columns = network.encoder.grid(*batch.size)
    shape = (*informative.shape, 1 + rows * columns, network.config.encoder.channels)
    dtype = network.encoder.cls_token.dtype
    joint = [batch.images.new_zeros(shape, dtype=dtype) for _ in range(2)]
    for pattern in torch.unique(informative, dim=0):
        samples = (informative == pattern).all(1).nonzero()[:, 0]
        views = pattern.nonzero()[:, 0]
        if len(views) == batch.context:
            part = [features[samples] for features in alone()]
        else:
            part = encode_views(network, batch.samples(samples), views, config=config)
        for level, features in zip(joint, part, strict=True):
            level[samples[:, None], views] = features
    return joint


def encode_views(
    network: DepthAnything3, batch: ViewBatch, views: slice | Tensor, *, config: HintConfig
) -> list[Tensor]:
    """Raw levels 0 and 1 of some views, token 0 included; gradients reach the encoder."""
    images = batch.images[:, views]
    if not config.cameras:
        return network.encode(images, levels=2)
    cameras = _relative_cameras(batch, config.camera_unit)
    return network.encode(images, levels=2, cam_from_world=cameras[:, views], K=batch.K[:, views])


def _relative_cameras(batch: ViewBatch, unit: str) -> Tensor:
    """(B, V, 4, 4) cameras relative to the first view, as the encoder is told them."""
    # The camera encoder's unit has a floor, a tenth of a scene unit: in shares of the views' extent
    # it means the same in every scene.
    poses, scale = normalised_poses(torch.linalg.inv(batch.cam_from_world), reference=0)
    normalised = torch.linalg.inv(poses)
    cameras, _ = relative_cameras(normalised)
    if unit == "median":
        return cameras
    depth = batch.depth[:, : batch.context].flatten(1)
    known = (depth > 0) & torch.isfinite(depth)
    mean = torch.where(known, depth, 0.0).sum(1) / known.sum(1).clamp_min(1)
    in_depths = normalised.clone()
    in_depths[..., :3, 3] /= (scale * mean).clamp_min(torch.finfo(mean.dtype).tiny)[:, None, None]
    known_unit = (mean > 0)[:, None, None, None]
    return torch.where(known_unit, in_depths, cameras.to(in_depths.dtype)).to(cameras.dtype)


def maps(level: Tensor, grid: tuple[int, int]) -> Tensor:
    """(B, V, 1 + N, C) tokens to (B, V, C, h, w) maps, without token 0."""
    return level[:, :, 1:].transpose(2, 3).unflatten(3, grid)
