"""Depth Anything 3 alone, from a folder: as published, or out of a GeoVerse folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gvtools.errors import CheckpointError, OptionError
from gvtools.networks.config_json import from_json
from gvtools.networks.depth_anything.encoder import EncoderConfig
from gvtools.networks.depth_anything.geometry_head import GeometryHeadConfig
from gvtools.networks.depth_anything.network import DepthAnything3, DepthAnythingConfig
from gvtools.networks.tensor_files import TensorFiles, read_tensors
from gvtools.networks.tensors import load, not_finite, share_tied
from gvtools.untrusted import read_json


@dataclass(frozen=True)
class Released:
    """A released model.

    Attributes:
        config: its dimensions.
        licence: of its weights.
    """

    config: DepthAnythingConfig
    licence: str


# By their publisher's name, below depth-anything/ of Hugging Face.
RELEASED = {
    "DA3-SMALL": Released(
        DepthAnythingConfig(
            EncoderConfig(width=384, heads=6), GeometryHeadConfig(768, 64, (48, 96, 192, 384))
        ),
        "Apache-2.0",
    ),
    "DA3-BASE": Released(DepthAnythingConfig(), "Apache-2.0"),
    "DA3-LARGE-1.1": Released(
        DepthAnythingConfig(
            EncoderConfig(
                width=1024,
                depth=24,
                heads=16,
                alternate_from=8,
                qk_norm_from=8,
                rotary_from=8,
                taps=(11, 15, 19, 23),
            ),
            GeometryHeadConfig(2048, 256, (256, 512, 1024, 1024)),
        ),
        "CC BY-NC 4.0, not for commercial use",
    ),
}
# Where the published file may lie in a folder, and the prefix of its keys.
PUBLISHED_FILE = "model.safetensors"
PUBLISHED_PLACES = ("pretrained_models/da3/model.safetensors", "da3/model.safetensors")
PUBLISHED_PREFIX = "model."
# A GeoVerse folder: its weights, its configuration, and the prefix of this network's keys.
GEOVERSE_FILE = "geoverse.safetensors"
GEOVERSE_CONFIG = "config.json"
GEOVERSE_PREFIX = "geometry."


def tied_norms(start: str) -> tuple[tuple[str, ...], ...]:
    """Names of the one LayerNorm that the four ray outputs share; files hold it under one name.

    Args:
        start: prefix of the head's keys.
    """
    return tuple(
        tuple(f"{start}scratch.output_conv2_aux.{level}.2.{kind}" for level in range(4))
        for kind in ("weight", "bias")
    )


def find_weights(folder: Path | str) -> Path:
    """The file that holds Depth Anything 3's weights."""
    folder = Path(folder)
    if folder.is_file():
        return folder
    names = (GEOVERSE_FILE, PUBLISHED_FILE, *PUBLISHED_PLACES)
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise CheckpointError(
        f"{folder}: no {PUBLISHED_FILE} of DA3-SMALL, -BASE or -LARGE and no {GEOVERSE_FILE}; "
        "download model.safetensors of depth-anything/DA3-BASE (Apache-2.0, 0.5 GB) into a folder "
        "and name that"
    )


def load_depth_anything(
    folder: Path | str,
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> DepthAnything3:
    """The network, strictly loaded, frozen, in evaluation mode.

    Args:
        folder: with ``model.safetensors`` of DA3-SMALL, -BASE or -LARGE, or a GeoVerse folder.
        device: of the weights.
        dtype: of the autocast that it is run in, see ``DepthAnything3.hold_in``.
    """
    path = find_weights(folder)
    if path.name == GEOVERSE_FILE:
        config = _geoverse_config(path.with_name(GEOVERSE_CONFIG))
        files = TensorFiles.find(path)
        tensors = {
            name.removeprefix(GEOVERSE_PREFIX): files.read(name)
            for name in files.places
            if name.startswith(GEOVERSE_PREFIX)
        }
    else:
        stored = read_tensors(path)
        tensors = {name.removeprefix(PUBLISHED_PREFIX): value for name, value in stored.items()}
        share_tied(tensors, tied_norms("head."), where=path)
        token = tensors.get("backbone.pretrained.cls_token")
        width = 0 if token is None else token.shape[-1]
        by_width = {model.config.encoder.width: model.config for model in RELEASED.values()}
        if width not in by_width:
            raise CheckpointError(
                f"{path}: tokens of {width} channels; expected Depth Anything 3 Small (384), Base "
                "(768) or Large (1024)"
            )
        config = by_width[width]
    with torch.device("meta"):
        network = DepthAnything3(config)
    bad = not_finite(tensors)
    if bad is not None:
        raise CheckpointError(f"{path}: {bad} holds values that are not finite")
    load(network, tensors, where=path)
    network.hold_in(dtype)
    return network.requires_grad_(False).eval().to(device)


def _geoverse_config(path: Path) -> DepthAnythingConfig:
    try:
        stored: Any = read_json(path)
        return from_json(DepthAnythingConfig, stored.get("geometry", {}), where="geometry")
    except FileNotFoundError:
        raise CheckpointError(
            f"no {path}; expected the config.json of a GeoVerse folder (gvtools weights list)"
        ) from None
    except (OSError, ValueError, AttributeError, OptionError) as error:
        raise CheckpointError(f"{path}: {error}; expected a GeoVerse configuration") from None
