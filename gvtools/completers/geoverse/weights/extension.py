"""What GeoVerse adds to the published networks, untrained: it leaves them as they are.

Depth condition, and control branch or shared attention: ``published.EXTENSION`` has their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from gvtools.completers.geoverse.control import ControlBranch
from gvtools.completers.geoverse.denoiser import Denoiser
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.shared_attention import SharedAttention
from gvtools.completers.geoverse.weights.checkpoints import is_extension, load

_DEPTH, _LEVEL1 = "level1.depth_embedder.", "level1."
# Of what starts at random; nothing of it reaches the output before training.
_SEED = 0


def fresh_extension(model: GeoVerse, loaded: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Untrained extensions, the same at every call.

    The output is bit for bit that of the published networks, but for the ungated MoT variant.

    Args:
        model: may be on the meta device.
        loaded: the published tensors by their names in ``model``; the control branch starts as a
            copy of some.
    """
    config = model.config
    fresh = {
        name: torch.zeros(tuple(tensor.shape))
        for name, tensor in model.state_dict().items()
        if name.startswith(_DEPTH)
    }
    if config.video is None:
        return fresh
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(_SEED)
        if model.control is not None:
            control = ControlBranch(
                config.control,
                _published_level1(model, loaded),
                video_channels=config.video.channels,
            )
            fresh |= {f"control.{name}": value for name, value in control.state_dict().items()}
        if model.shared is not None:
            shared = SharedAttention(
                config.shared,
                width=config.level1.width,
                heads=config.level1.heads,
                video_channels=config.video.channels,
            )
            fresh |= {f"shared.{name}": value for name, value in shared.state_dict().items()}
    return fresh


def _published_level1(model: GeoVerse, loaded: Mapping[str, Tensor]) -> Denoiser:
    with torch.device("meta"):
        denoiser = Denoiser(replace(model.config.level1, depth_condition=False))
    tensors = {
        name.removeprefix(_LEVEL1): tensor
        for name, tensor in loaded.items()
        if name.startswith(_LEVEL1) and not is_extension(name)
    }
    load(denoiser, tensors, where="level1")
    return denoiser
