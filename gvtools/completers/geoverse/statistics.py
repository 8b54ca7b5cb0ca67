"""Mean and variance of latent channels: features of a frozen encoder to a diffusion model's units.

The encoder's channels are heavy-tailed (Depth Anything 3 Base, level 1: deviations from 0.14 to
10), so latents are normalised channel by channel, as in Geometric Latent Diffusion.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class LatentStatistics(nn.Module):
    """Per-channel statistics of one feature level.

    Args:
        channels: of the level.
        eps: added to the variance.
    """

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
