"""The MoT variant: geometric queries attend jointly to geometric and video keys and values.

Asymmetric, as the paper's appendix has it: video features do not see the geometric state, so their
keys and values are computed once a pass and reused by every denoising step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.projective import Projective
from gvtools.networks.attention import attend


@dataclass(frozen=True)
class SharedAttentionConfig:
    """Where and how video features enter the denoiser's attention.

    Attributes:
        layers: encoder blocks that are coupled, one for each video level.
        gated: the joint attention replaces the geometric one by a learned share that starts at
            zero, so that a fresh extension leaves a pretrained denoiser as it is. Without it the
            attention is joint from the first step: the paper's form.
    """

    layers: tuple[int, ...] = (0, 7, 14, 21)
    gated: bool = True


@dataclass(frozen=True)
class VideoKeys:
    """Keys and values of the video tokens for one block.

    Attributes:
        key: (B, heads, V * M, head_dim), projectively transformed.
        value: likewise.
        gate: share of the joint attention; None for all of it.
    """

    key: Tensor
    value: Tensor
    gate: Tensor | None

    def attend(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Attention of (B, heads, T, head_dim) over both kinds of tokens."""
        key, value = self.key.to(k.dtype), self.value.to(v.dtype)
        joint = attend(q, torch.cat((key, k), dim=2), torch.cat((value, v), dim=2))
        if self.gate is None:
            return joint
        alone = attend(q, k, v)
        return alone + self.gate.to(v.dtype) * (joint - alone)


class SharedAttention(nn.Module):
    """Projects video features to keys and values of the coupled blocks.

    Args:
        config: see ``SharedAttentionConfig``.
        width: channels of the denoiser's encoder.
        heads: its attention heads.
        video_channels: channels of the video features.
    """

    def __init__(
        self, config: SharedAttentionConfig, *, width: int, heads: int, video_channels: int
    ) -> None:
        super().__init__()
        self.config = config
        self.heads = heads
        self.norms = nn.ModuleList(nn.RMSNorm(video_channels, eps=1e-6) for _ in config.layers)
        self.kv = nn.ModuleList(nn.Linear(video_channels, 2 * width) for _ in config.layers)
        if config.gated:
            self.gates = nn.Parameter(torch.zeros(len(config.layers)))

    def forward(
        self, features: Sequence[Tensor], positions: Sequence[Projective]
    ) -> dict[int, VideoKeys]:
        """Keys and values by block, to be computed once and handed to every step.

        Args:
            features: a (B, V, C, h', w') tensor a coupled layer.
            positions: of the video grid, for each of them, in the units of the latents' grid.
        """
        found = {}
        dtype = next(self.parameters()).dtype
        for index, (layer, feature) in enumerate(zip(self.config.layers, features, strict=True)):
            tokens = feature.flatten(3).transpose(2, 3).flatten(1, 2)
            kv = self.kv[index](self.norms[index](tokens.to(dtype)))
            key, value = kv.unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
            gate = self.gates[index] if self.config.gated else None
            found[layer] = VideoKeys(positions[index].key(key), positions[index].value(value), gate)
        return found
