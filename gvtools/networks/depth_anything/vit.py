"""Layers of the vision transformer that Depth Anything 3 is built from.

Parameter names are those of the published checkpoints (``norm1``, ``attn.qkv``, ``ls1.gamma`` ...).
Source: DINOv2 (Oquab et al. 2023) with the query/key norm and 2-D rotary positions of Depth
Anything 3 (Lin et al. 2025).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gvtools.networks.attention import attend


@dataclass(frozen=True)
class RotaryTable:
    """Cosines and sines of 2-D rotary positions, computed once for all blocks of a pass.

    Attributes:
        cos: (T, 2, head_dim / 4) of each token: axis y, then axis x.
        sin: likewise.
    """

    cos: Tensor
    sin: Tensor

    @classmethod
    def of(cls, positions: Tensor, head_dim: int, *, base: float = 100.0) -> RotaryTable:
        """The table of (T, 2) positions, y before x; angles are computed in float32."""
        frequencies = head_dim // 4
        exponent = torch.arange(frequencies, device=positions.device) / frequencies
        angle = positions.float()[:, :, None] * base**-exponent
        return cls(angle.cos(), angle.sin())

    def rotate(self, x: Tensor) -> Tensor:
        """(B, heads, T, head_dim) rotated; the pairs of an axis are its two halves."""
        first, second = x.unflatten(-1, (2, 2, -1)).unbind(-2)
        cos, sin = self.cos.to(x.dtype), self.sin.to(x.dtype)
        rotated = torch.stack((first * cos - second * sin, second * cos + first * sin), dim=-2)
        return rotated.flatten(-3)


class Attention(nn.Module):
    """Multi-head self-attention, optionally with normed queries and keys.

    Args:
        width: channels.
        heads: divides ``width``.
        qk_norm: LayerNorm over each head's queries and keys.
    """

    def __init__(self, width: int, heads: int, *, qk_norm: bool = False) -> None:
        super().__init__()
        self.heads = heads
        head_dim = width // heads
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm: nn.Module = nn.LayerNorm(head_dim) if qk_norm else nn.Identity()
        self.k_norm: nn.Module = nn.LayerNorm(head_dim) if qk_norm else nn.Identity()
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, rotary: RotaryTable | None = None) -> Tensor:
        """(B, T, width) to the same; ``rotary`` has the positions of the T tokens."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = self.q_norm(q), self.k_norm(k)
        if rotary is not None:
            q, k = rotary.rotate(q), rotary.rotate(k)
        return self.proj(attend(q, k, v).transpose(1, 2).flatten(2))


class LayerScale(nn.Module):
    """One learned factor a channel."""

    def __init__(self, width: int, initial: float = 1.0) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), initial))

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) scaled."""
        return x * self.gamma


class Mlp(nn.Module):
    """Two linear layers with the exact GELU between them."""

    def __init__(self, width: int, hidden: int, out: int | None = None) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.act = nn.GELU()
        self.fc2 = nn.Linear(hidden, out or width)

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) to (..., out)."""
        return self.fc2(self.act(self.fc1(x)))


class Block(nn.Module):
    """Pre-norm transformer block with layer scale.

    Args:
        width: channels.
        heads: divides ``width``.
        mlp_ratio: hidden width of the MLP over ``width``.
        qk_norm: see ``Attention``.
        eps: of the two LayerNorms: 1e-6 in the backbone, 1e-5 in the camera encoder.
        layer_scale: initial factor of both branches.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        *,
        mlp_ratio: float = 4.0,
        qk_norm: bool = False,
        eps: float = 1e-6,
        layer_scale: float = 1.0,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=eps)
        self.attn = Attention(width, heads, qk_norm=qk_norm)
        self.ls1 = LayerScale(width, layer_scale)
        self.norm2 = nn.LayerNorm(width, eps=eps)
        self.mlp = Mlp(width, int(width * mlp_ratio))
        self.ls2 = LayerScale(width, layer_scale)

    def forward(self, x: Tensor, rotary: RotaryTable | None = None) -> Tensor:
        """(B, T, width) to the same."""
        x = x + self.ls1(self.attn(self.norm1(x), rotary))
        return x + self.ls2(self.mlp(self.norm2(x)))
