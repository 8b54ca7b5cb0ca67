"""The two ways in which video features enter the denoiser: a control branch, or shared attention.

The ControlNet-style branch makes them residuals of the denoiser's encoder. For each video level l,
with the denoiser's token stream h and the control stream c (Eqs. 5, 6)::

    c[l+1] = B_ctrl[l](c[l] + A[l](F_W[l]); t, cameras),   c[0] = the tokens that enter the encoder
    h      = B(h; t, cameras) + Z[l](c[l+1])

B_ctrl starts as a copy of the denoiser's blocks, Z at zero: a fresh branch changes nothing, and on
the first step only Z receives a gradient.

In the MoT variant geometric queries attend jointly to geometric and video keys and values.
Asymmetric, as the paper's appendix has it: video features do not see the geometric state, so their
keys and values are computed once a pass and reused by every denoising step.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gvtools.completers.geoverse.camera_encoding import CameraCondition, Projective
from gvtools.completers.geoverse.denoiser import (
    Conditions,
    Denoiser,
    DenoiserConfig,
    Positions,
    VideoKeys,
)
from gvtools.completers.geoverse.video_prior import VideoFeatures
from gvtools.networks.compute import Recomputing


@dataclass(frozen=True)
class ControlConfig:
    """Where the control branch enters."""

    # Encoder blocks of the denoiser after which a residual is added, one for each video level. The
    # paper does not name them: spread over GLD's 28 by default.
    layers: tuple[int, ...] = (0, 7, 14, 21)


class FeatureAdapter(nn.Module):
    """A[l]: video features at the tokens' resolution and width."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(channels, width, 1)
        self.mix = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, feature: Tensor, grid: tuple[int, int]) -> Tensor:
        """(B, V, C, h', w') to (B, V, N, width)."""
        batch_views = feature.shape[:2]
        x = self.reduce(feature.flatten(0, 1).to(self.reduce.weight.dtype))
        if tuple(x.shape[-2:]) != grid:
            x = F.interpolate(x, size=grid, mode="bilinear", align_corners=False)
        x = self.mix(F.silu(x))
        return x.flatten(2).transpose(1, 2).unflatten(0, batch_views)


class ControlBranch(Recomputing):
    """The control branch; copies the denoiser's blocks at the control layers."""

    def __init__(self, config: ControlConfig, denoiser: Denoiser, *, video_channels: int) -> None:
        super().__init__()
        self.config = config
        width = denoiser.config.width
        self.adapters = nn.ModuleList(FeatureAdapter(video_channels, width) for _ in config.layers)
        self.blocks = nn.ModuleList(copy.deepcopy(denoiser.blocks[i]) for i in config.layers)
        self.outputs = nn.ModuleList(nn.Linear(width, width) for _ in config.layers)
        for parameter in self.outputs.parameters():
            nn.init.zeros_(parameter)

    def adapted(self, features: Sequence[Tensor], grid: tuple[int, int]) -> list[Tensor]:
        """A[l](F_W[l]) of all levels; does not depend on the step, so compute it once."""
        return [
            adapter(feature, grid) for adapter, feature in zip(self.adapters, features, strict=True)
        ]

    def forward(
        self,
        denoiser: Denoiser,  # whose embedders and time embedding the branch shares
        noisy: Tensor,  # (B, V, C, h, w)
        t: Tensor,  # (B,) or (B, V)
        conditions: Conditions,  # as the denoiser gets them
        *,
        adapted: Sequence[Tensor],  # from ``adapted``
        positions: Positions,  # as the denoiser gets them
    ) -> dict[int, Tensor]:
        """The residuals of this step, (B, V, N, width) by encoder block."""
        stream = denoiser.encoder_tokens(noisy, conditions)
        c = F.silu(denoiser.time(t, noisy.shape[1]).to(stream.dtype))
        residuals = {}
        for index, layer in enumerate(self.config.layers):
            entering = stream + adapted[index]
            stream = self.layer(self.blocks[index], entering, c, positions.encoder)
            residuals[layer] = self.outputs[index](stream)
        return residuals


@dataclass(frozen=True)
class SharedAttentionConfig:
    """Where and how video features enter the denoiser's attention."""

    # Encoder blocks that are coupled, one for each video level.
    layers: tuple[int, ...] = (0, 7, 14, 21)
    # The joint attention replaces the geometric one by a learned share that starts at zero, so that
    # a fresh extension leaves a pretrained denoiser as it is. Without it the attention is joint
    # from the first step: the paper's form.
    gated: bool = True


class SharedAttention(nn.Module):
    """Projects video features to keys and values of the denoiser's coupled blocks."""

    def __init__(
        self, config: SharedAttentionConfig, denoiser: DenoiserConfig, *, video_channels: int
    ) -> None:
        super().__init__()
        self.config, self.denoiser = config, denoiser
        width = 2 * denoiser.width
        self.norms = nn.ModuleList(nn.RMSNorm(video_channels, eps=1e-6) for _ in config.layers)
        self.kv = nn.ModuleList(nn.Linear(video_channels, width) for _ in config.layers)
        if config.gated:
            self.gates = nn.Parameter(torch.zeros(len(config.layers)))

    def forward(
        self, features: VideoFeatures, camera: CameraCondition, grid: tuple[int, int]
    ) -> dict[int, VideoKeys]:
        """Keys and values by block, of a (B, V, C, h', w') tensor for each coupled layer.

        Positioned by the views' cameras, in the units of the latents' ``grid`` (h, w).
        """
        found = {}
        dtype = next(self.parameters()).dtype
        heads = self.denoiser.heads
        for index, (layer, feature) in enumerate(zip(self.config.layers, features, strict=True)):
            own = (feature.shape[-2], feature.shape[-1])
            positions = Projective(
                camera.cam_from_world,
                camera.K,
                camera.size,
                grid=own,
                head_dim=self.denoiser.width // heads,
                position_scale=(grid[0] / own[0], grid[1] / own[1]),
                invert_K=self.denoiser.invert_K,
            )
            tokens = feature.flatten(3).transpose(2, 3).flatten(1, 2)
            kv = self.kv[index](self.norms[index](tokens.to(dtype)))
            key, value = kv.unflatten(-1, (2, heads, -1)).permute(2, 0, 3, 1, 4)
            gate = self.gates[index] if self.config.gated else None
            found[layer] = VideoKeys(positions.key(key), positions.value(value), gate)
        return found
