"""Depth Anything 3 alone, from a folder: as published, or out of a GeoVerse folder."""

from __future__ import annotations

from pathlib import Path

import torch

from gvtools.completers.geoverse.config import read
from gvtools.completers.geoverse.weights.checkpoints import (
    check_finite,
    load,
    read_part,
    read_tensors,
)
from gvtools.completers.geoverse.weights.published import CONFIG_FILE, PARTS, WHOLE_FILE
from gvtools.errors import CheckpointError
from gvtools.networks.depth_anything.encoder import EncoderConfig
from gvtools.networks.depth_anything.geometry_head import GeometryHeadConfig
from gvtools.networks.depth_anything.network import DepthAnything3, DepthAnythingConfig

# Released models by the width of their tokens.
RELEASED = {
    384: DepthAnythingConfig(
        EncoderConfig(width=384, heads=6), GeometryHeadConfig(768, 64, (48, 96, 192, 384))
    ),
    768: DepthAnythingConfig(),
}
PUBLISHED_FILE = "model.safetensors"
GEOMETRY = next(part for part in PARTS if part.name == "geometry")


def find_weights(folder: Path | str) -> Path:
    """The file that holds Depth Anything 3's weights.

    Raises:
        CheckpointError: the folder or the file is absent.
    """
    folder = Path(folder)
    if folder.is_file():
        return folder
    names = (WHOLE_FILE, PUBLISHED_FILE, *GEOMETRY.files)
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise CheckpointError(
        f"{folder}: no {PUBLISHED_FILE} of DA3-SMALL or DA3-BASE and no {WHOLE_FILE} in it; "
        "download model.safetensors of depth-anything/DA3-BASE (Apache-2.0, 0.5 GB) into a folder "
        "and name that"
    )


def load_depth_anything(
    folder: Path | str, *, device: torch.device | str = "cpu"
) -> DepthAnything3:
    """The network, strictly loaded, frozen, in evaluation mode.

    Args:
        folder: with ``model.safetensors`` of DA3-SMALL or DA3-BASE, or a GeoVerse folder.
        device: of the weights.

    Raises:
        CheckpointError: nothing there, or a tensor that does not fit.
    """
    path = find_weights(folder)
    if path.name == WHOLE_FILE:
        config = read(path.with_name(CONFIG_FILE)).geometry
        start = GEOMETRY.module
        tensors = {
            name.removeprefix(start): tensor
            for name, tensor in read_tensors(path).items()
            if name.startswith(start)
        }
    else:
        tensors = read_part(path, GEOMETRY)
        token = tensors.get("backbone.pretrained.cls_token")
        width = 0 if token is None else token.shape[-1]
        if width not in RELEASED:
            raise CheckpointError(
                f"{path}: tokens of {width} channels; expected Depth Anything 3 Small (384) or "
                "Base (768)"
            )
        config = RELEASED[width]
    with torch.device("meta"):
        network = DepthAnything3(config)
    check_finite(tensors, where=path)
    load(network, tensors, where=path)
    return network.requires_grad_(False).eval().to(device)
