"""The layers of a denoiser: embedders, attention over all views, modulated transformer blocks.

Parameter names are those of Geometric Latent Diffusion's checkpoints.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.projective import Projective
from gvtools.completers.geoverse.shared_attention import VideoKeys
from gvtools.networks.attention import attend


class PixelEmbed(nn.Module):
    """(B, C, H, W) to tokens (B, N, width) by patches."""

    def __init__(self, channels: int, width: int, patch: int = 1) -> None:
        super().__init__()
        self.proj = nn.Conv2d(channels, width, kernel_size=patch, stride=patch)

    def forward(self, x: Tensor) -> Tensor:
        """Tokens, row-major."""
        return self.proj(x).flatten(2).transpose(1, 2)


class TimeEmbed(nn.Module):
    """t in [0, 1] to a vector, by frozen Gaussian Fourier features."""

    W: Tensor

    def __init__(self, width: int, frequencies: int) -> None:
        super().__init__()
        self.W = nn.Parameter(torch.randn(frequencies), requires_grad=False)
        self.mlp = nn.Sequential(
            nn.Linear(2 * frequencies, width), nn.SiLU(), nn.Linear(width, width)
        )

    def forward(self, t: Tensor) -> Tensor:
        """(...,) to (..., width); the angles are computed in float32."""
        angle = t[..., None].float() * self.W.float() * (2 * math.pi)
        return self.mlp(torch.cat((angle.sin(), angle.cos()), -1).to(self.W.dtype))


class SwiGLU(nn.Module):
    """Gated MLP: w3(silu(a) * b) with [a, b] = w12(x)."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.w12 = nn.Linear(width, 2 * hidden)
        self.w3 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) to the same."""
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(nn.functional.silu(gate) * value)


class CameraAttention(nn.Module):
    """Self-attention over all tokens of all views, with projective positions."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(
        self,
        x: Tensor,
        positions: Projective,
        video: VideoKeys | None = None,
    ) -> Tensor:
        """(B, T, width) to the same; ``video`` holds further keys and values (MoT variant)."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k, v = positions.query(q), positions.key(k), positions.value(v)
        out = attend(q, k, v) if video is None else video.attend(q, k, v)
        return self.proj(positions.output(out).transpose(1, 2).flatten(2))


class DenoiserBlock(nn.Module):
    """Attention and MLP, each shifted, scaled and gated by the conditioning vector."""

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.norm1 = nn.RMSNorm(width, eps=1e-6)
        self.attn = CameraAttention(width, heads)
        self.norm2 = nn.RMSNorm(width, eps=1e-6)
        self.mlp = SwiGLU(width, int(2 / 3 * int(width * mlp_ratio)))
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(
        self,
        x: Tensor,
        c: Tensor,
        positions: Projective,
        video: VideoKeys | None = None,
    ) -> Tensor:
        """Tokens under their conditioning.

        Args:
            x: (B, V, N, width).
            c: (B, V, 1 or N, width).
            positions: of the V * N tokens.
            video: see ``CameraAttention``.
        """
        shift1, scale1, gate1, shift2, scale2, gate2 = self.adaLN_modulation(c).chunk(6, dim=-1)
        inner = modulated(self.norm1(x), shift1, scale1).flatten(1, 2)
        x = x + gate1 * self.attn(inner, positions, video).view_as(x)
        return x + gate2 * self.mlp(modulated(self.norm2(x), shift2, scale2))


class FinalLayer(nn.Module):
    """Tokens to latent channels."""

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        self.norm_final = nn.RMSNorm(width, eps=1e-6)
        self.linear = nn.Linear(width, channels)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * width))

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        """(B, V, N, width) under (B, V, N, width) to (B, V, N, channels)."""
        shift, scale = self.adaLN_modulation(c).chunk(2, dim=-1)
        return self.linear(modulated(self.norm_final(x), shift, scale))


def modulated(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """``x`` (1 + scale) + shift."""
    return x * (1 + scale) + shift
