"""A GeoVerse of random numbers and views of nothing: values change neither time nor memory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.video_prior import VideoFeatures, VideoPrior, VideoPriorConfig
from gvtools.completers.geoverse.wan import dtype_of, empty_network

# Of random weights: small enough for the activations of deep networks to stay finite.
DEVIATION = 0.02
# Share of the targets' pixels that the projection knows, in blocks of an eighth of a side.
KNOWN = 0.7
BLOCKS = 8
TOKEN = 16  # px of a video token's edge


def random_model(
    config: GeoVerseConfig, device: torch.device | str = "cpu", *, seed: int = 0
) -> GeoVerse:
    """A model in evaluation mode, without its video prior.

    Nothing is left at zero, as a fresh denoiser's gates are: zeros take a GPU less power, and so
    less time.
    """
    device = torch.device(device)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        with device:
            model = GeoVerse(config)
        for parameter in model.parameters():
            if not bool(parameter.any()):
                nn.init.normal_(parameter, std=DEVIATION)
    return model.eval()


def random_video(config: VideoPriorConfig, device: torch.device | str = "cpu") -> VideoPrior:
    """A video prior of the published network's sizes, truncated behind the last tap."""
    # What diffusers takes by default is the published network.
    sizes = {"num_layers": config.taps[-1] + 1, "vace_layers": list(config.taps)}
    dtype = getattr(torch, config.dtype or "bfloat16")
    transformer: Any = _filled(empty_network("transformer", sizes), device, dtype)
    table = transformer.config
    with torch.device(device):
        # Computed, not stored.
        transformer.rope = type(transformer.rope)(
            table.attention_head_dim, table.patch_size, table.rope_max_seq_len
        )
    vae = _filled(empty_network("vae", {}), device, torch.float32)
    return VideoPrior(transformer, vae, config=replace(config, prompt="zeros"))


def random_features(config: GeoVerseConfig, batch: ViewBatch) -> VideoFeatures | None:
    """What a video prior would give for the batch, on its device; None where there is none."""
    if config.video is None:
        return None
    rows, columns = (side // TOKEN for side in config.video.size(*batch.size))
    samples, views = batch.images.shape[:2]
    shape = (samples, views, config.video.channels, rows, columns)
    levels = tuple(torch.randn(shape, device=batch.images.device) for _ in config.video.taps)
    return VideoFeatures(levels, tuple(range(views)))


def _filled(network: nn.Module, device: torch.device | str, dtype: torch.dtype) -> nn.Module:
    """A network of the meta device on another, with random weights."""

    def random(name: str, like: Tensor) -> Tensor:
        empty = torch.empty(like.shape, dtype=dtype_of(name, dtype), device=device)
        return empty.normal_(std=DEVIATION)

    state = {name: random(name, like) for name, like in network.state_dict().items()}
    network.load_state_dict(state, assign=True)
    return network


def random_views(size: tuple[int, int], *, context: int, targets: int, seed: int = 0) -> ViewBatch:
    """One sample of views on an arc about a point in front of them.

    ``size``: (H, W), px.
    """
    generator = torch.Generator().manual_seed(seed)
    views, (height, width) = context + targets, size

    def uniform(*shape: int) -> Tensor:
        return torch.rand(1, views, *shape, generator=generator)

    known = uniform(1, BLOCKS, BLOCKS) < KNOWN
    known[:, :context] = True
    rows, columns = (torch.arange(side) * BLOCKS // side for side in size)
    valid = known[..., rows[:, None], columns]
    turn = torch.linspace(-0.3, 0.3, views)
    pose = torch.eye(4).repeat(1, views, 1, 1)
    pose[0, :, 0, 0] = pose[0, :, 2, 2] = turn.cos()
    pose[0, :, 0, 2], pose[0, :, 2, 0] = -turn.sin(), turn.sin()
    # Turned about (0, 0, 2), which stays in the middle of every view.
    pose[0, :, 0, 3], pose[0, :, 2, 3] = 2 * turn.sin(), 2 - 2 * turn.cos()
    focal = float(max(size))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return ViewBatch(
        images=uniform(3, height, width) * valid,
        depth=(1.5 + uniform(1, height, width)) * valid,
        valid=valid,
        cam_from_world=pose,
        K=K.repeat(1, views, 1, 1),
        context=context,
    )
