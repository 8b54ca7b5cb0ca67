"""Wan VACE networks of the published architecture with few, random numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gvtools.completers.geoverse.video_prior.prior import VideoPrior, VideoPriorConfig
from gvtools.completers.geoverse.video_prior.wan_library import network_class

TEXT = 20
TAPS = (0, 1, 2, 3)
CONFIG = VideoPriorConfig(taps=TAPS, channels=48, prompt_rows=6)


def transformer(layers: int = 4, vace: tuple[int, ...] = (0, 2), *, seed: int = 0) -> Any:
    torch.manual_seed(seed)
    network = network_class("transformer")(
        num_attention_heads=2,
        attention_head_dim=24,
        text_dim=TEXT,
        freq_dim=16,
        ffn_dim=40,
        num_layers=layers,
        vace_layers=list(vace),
    )
    # As they are created these are all ones or zeros: a mix-up of names would not show.
    for name, parameter in network.named_parameters():
        if "norm" in name or name.endswith("bias"):
            parameter.data += 0.1 * torch.randn_like(parameter)
    return network.eval()


def vae(*, seed: int = 1) -> Any:
    torch.manual_seed(seed)
    kind = network_class("vae")
    return kind(base_dim=4, dim_mult=[1, 2, 2, 2], num_res_blocks=1).eval()


def prompt() -> Tensor:
    return torch.randn(1, TEXT, generator=torch.Generator().manual_seed(2))


def prior(network: Any = None, **options: Any) -> VideoPrior:
    return VideoPrior(
        transformer() if network is None else network,
        vae(),
        prompt(),
        config=replace(CONFIG, **options),
    )


def views(
    count: int, *, batch: int = 1, size: tuple[int, int] = (32, 48), seed: int = 3
) -> tuple[Tensor, Tensor]:
    """Pictures, and validity that is full in the first view."""
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(batch, count, 3, *size, generator=generator)
    valid = torch.rand(batch, count, 1, *size, generator=generator) > 0.3
    valid[:, 0] = True
    return images, valid
