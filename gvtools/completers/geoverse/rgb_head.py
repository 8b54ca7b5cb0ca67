"""The RGB head: features of the four levels to a picture, each view by itself.

Geometric Latent Diffusion's decoder: a linear layer on the concatenated levels, a class token, a
fixed 2-D sine table, pre-norm transformer layers, and a linear layer to the pixels of a patch.
Parameter names are those of the published checkpoint.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gvtools.networks.compute import Recomputing, RememberedTable, attend, constant
from gvtools.networks.depth_anything.encoder import IMAGENET_MEAN, IMAGENET_STD

SINE_BASE = 10000.0


@dataclass(frozen=True)
class RGBHeadConfig:
    """Dimensions; the defaults are the published decoder for Depth Anything 3 Base."""

    in_channels: int = 6144  # of a token: the four levels of 2 x 768, one after the other
    width: int = 1152  # channels of the transformer
    depth: int = 28  # its layers
    heads: int = 16  # its attention heads
    mlp: int = 4096  # hidden width of its MLPs
    patch: int = 14  # patch edge, px
    # (h, w) of the position table, patches; other grids are interpolated.
    base_grid: tuple[int, int] = (36, 36)
    eps: float = 1e-12  # of the LayerNorms


class RGBHead(Recomputing):
    """The decoder; ``forward`` gives pictures, ``logits`` what they are made of."""

    decoder_pos_embed: Tensor

    def __init__(self, config: RGBHeadConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        self.register_buffer("decoder_pos_embed", sine_table(width, config.base_grid)[None])
        self._resized = RememberedTable()
        self.trainable_cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.decoder_embed = nn.Linear(config.in_channels, width)
        self.decoder_layers = nn.ModuleList(_Layer(config) for _ in range(config.depth))
        self.decoder_norm = nn.LayerNorm(width, eps=config.eps)
        self.decoder_pred = nn.Linear(width, config.patch**2 * 3)

    def forward(
        self, features: Tensor, grid: tuple[int, int], *, chunk: int | None = None
    ) -> Tensor:  # (B', 3, h * patch, w * patch) RGB, in [0, 1] but for overshoot
        """(B', 3, h * patch, w * patch) RGB, in [0, 1] but for overshoot.

        ``features`` (B', N, in_channels) are levels 0 to 3 concatenated, N = h * w tokens
        row-major. ``chunk`` views at a time bound the memory; the result is the same.
        """
        return self.image(self.logits(features, grid, chunk=chunk), grid)

    def logits(
        self, features: Tensor, grid: tuple[int, int], *, chunk: int | None = None
    ) -> Tensor:
        """(B', N, patch² · 3) pixels of the patches, ImageNet-normalised RGB; see ``forward``."""
        position = self.positions(grid)
        parts = features.split(max(chunk or len(features), 1))
        done = [self._views(part, position) for part in parts]
        return done[0] if len(done) == 1 else torch.cat(done)

    def image(self, logits: Tensor, grid: tuple[int, int]) -> Tensor:
        """(B', h·w, patch² · 3) logits as (B', 3, h * patch, w * patch) RGB, not clipped."""
        patch = self.config.patch
        pixels = logits.unflatten(2, (patch, patch, 3)).unflatten(1, grid)
        pixels = pixels.permute(0, 5, 1, 3, 2, 4).flatten(4, 5).flatten(2, 3)
        mean, std = (constant(c, pixels).view(3, 1, 1) for c in (IMAGENET_MEAN, IMAGENET_STD))
        return pixels * std + mean

    def positions(self, grid: tuple[int, int]) -> Tensor:
        """(1, 1 + h * w, width): the table, bicubic on grids other than its own."""
        table = self.decoder_pos_embed
        if tuple(grid) == tuple(self.config.base_grid):
            return table

        def resized() -> Tensor:
            plane = table[:, 1:].mT.unflatten(2, self.config.base_grid)
            dtype = torch.promote_types(plane.dtype, torch.float32)
            plane = F.interpolate(plane.to(dtype), size=grid, mode="bicubic", align_corners=False)
            return torch.cat((table[:, :1], plane.flatten(2).mT.to(table.dtype)), dim=1)

        return self._resized(tuple(grid), table, resized)

    def _views(self, features: Tensor, position: Tensor) -> Tensor:
        x = self.decoder_embed(features)
        x = torch.cat((self.trainable_cls_token.to(x.dtype).expand(len(x), -1, -1), x), dim=1)
        x = x + position.to(x.dtype)
        for layer in self.decoder_layers:
            x = self.layer(layer, x)
        return self.decoder_pred(self.decoder_norm(x)[:, 1:])


class _Layer(nn.Module):
    """Pre-norm attention and MLP."""

    def __init__(self, config: RGBHeadConfig) -> None:
        super().__init__()
        self.attention = _Attention(config)
        self.intermediate = _Dense(config.width, config.mlp)
        self.output = _Dense(config.mlp, config.width)
        self.layernorm_before = nn.LayerNorm(config.width, eps=config.eps)
        self.layernorm_after = nn.LayerNorm(config.width, eps=config.eps)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attention(self.layernorm_before(x))
        hidden = F.gelu(self.intermediate(self.layernorm_after(x)))
        return x + self.output(hidden)


class _Attention(nn.Module):
    """Self-attention within a view, under the names of the published layers."""

    def __init__(self, config: RGBHeadConfig) -> None:
        super().__init__()
        width = config.width
        self.heads = config.heads
        self.attention = nn.ModuleDict(
            {name: nn.Linear(width, width) for name in ("query", "key", "value")}
        )
        self.output = _Dense(width, width)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (
            self.attention[name](x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for name in ("query", "key", "value")
        )
        return self.output(attend(q, k, v).transpose(1, 2).flatten(2))


class _Dense(nn.Module):
    """A linear layer, one name deeper."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.dense = nn.Linear(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.dense(x)


def sine_table(width: int, grid: tuple[int, int]) -> Tensor:
    """(1 + h * w, width) fixed positions: a row of zeros for the class token, then the patches.

    The first half of the channels encodes the column, the second the row; each is the sines of
    width / 4 frequencies, then their cosines.
    """
    count = width // 4
    frequency = SINE_BASE ** -(torch.arange(count, dtype=torch.float64) / count)
    rows, columns = (torch.arange(edge, dtype=torch.float64) for edge in grid)
    halves = []
    for position in (columns.repeat(grid[0]), rows.repeat_interleave(grid[1])):
        angle = position[:, None] * frequency
        halves.append(torch.cat((angle.sin(), angle.cos()), dim=-1))
    table = torch.cat(halves, dim=-1)
    return torch.cat((table.new_zeros(1, width), table)).float()
