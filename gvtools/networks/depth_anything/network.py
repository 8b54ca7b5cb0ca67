"""Depth Anything 3: backbone, geometry head, camera encoder and decoder, and released weights.

Parameter names are those of the published ``model.safetensors`` without their prefix ``model.``.
Source: Depth Anything 3, Lin et al. 2025.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from gvtools.errors import CheckpointError
from gvtools.networks.compute import hold_in
from gvtools.networks.config_json import read_model_config
from gvtools.networks.depth_anything.encoder import (
    CameraDecoder,
    CameraEncoder,
    DepthAnythingBackbone,
    EncoderConfig,
    normalise_imagenet,
    patch_rays,
)
from gvtools.networks.depth_anything.geometry_head import (
    GeometryHead,
    GeometryHeadConfig,
    ViewGeometry,
)
from gvtools.networks.tensors import (
    TensorFiles,
    load,
    not_finite,
    read_tensors,
    shapes_alone,
    share_tied,
)


@dataclass(frozen=True)
class DepthAnythingConfig:
    """Dimensions of the whole network; the defaults are Depth Anything 3 Base."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)  # of the backbone
    head: GeometryHeadConfig = field(default_factory=GeometryHeadConfig)  # of the geometry head
    camera_heads: int = 16  # attention heads of the camera encoder
    camera_depth: int = 4  # blocks of the camera encoder
    camera_layer_scale: float = 0.01  # initial layer scale of the camera encoder


class _Named(nn.Module):
    """Holds the backbone under the name that the checkpoints give it."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.pretrained = DepthAnythingBackbone(config)


class DepthAnything3(nn.Module):
    """The network. Images are in [0, 1]; the first view is the reference view."""

    def __init__(self, config: DepthAnythingConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = _Named(config.encoder)
        self.head = GeometryHead(config.head)
        self.cam_enc = CameraEncoder(
            config.encoder.width,
            config.camera_heads,
            config.camera_depth,
            layer_scale=config.camera_layer_scale,
        )
        self.cam_dec = CameraDecoder(config.encoder.channels)

    def hold_in(self, dtype: torch.dtype) -> None:
        """Keep products' weights in autocast's type, see ``compute``; the head is float32."""
        hold_in(dtype, self.backbone, self.cam_enc, self.cam_dec)

    @property
    def encoder(self) -> DepthAnythingBackbone:
        """The backbone itself."""
        return self.backbone.pretrained

    def encode(
        self,
        images: Tensor,  # (B, V, 3, H, W) in [0, 1]
        *,
        levels: int | None = None,  # how many; None for all four
        # (B, V, 4, 4) cameras, when they are known; with ``K``.
        cam_from_world: Tensor | None = None,
        K: Tensor | None = None,  # (B, V, 3, 3), px of ``images``
    ) -> list[Tensor]:
        """Raw features of the first ``levels`` levels, token 0 included."""
        token = rays = None
        if cam_from_world is not None and K is not None:
            size = (images.shape[-2], images.shape[-1])
            token = self.cam_enc(cam_from_world, K, size)
            if self.config.encoder.rays:
                rays = patch_rays(cam_from_world, K, self.encoder.grid(*size), size=size)
        normalised = normalise_imagenet(images).to(self.encoder.cls_token.dtype)
        return self.encoder.encode(normalised, levels=levels, camera_token=token, rays=rays)

    def geometry(
        self, levels: list[Tensor], grid: tuple[int, int], *, views_at_once: int = 8
    ) -> ViewGeometry:
        """Depth and rays of four raw levels, token 0 included."""
        normed = [self.encoder.normed(level[:, :, 1:]) for level in levels]
        return self.head(normed, grid, views_at_once=views_at_once)

    def forward(
        self, images: Tensor, *, cam_from_world: Tensor | None = None, K: Tensor | None = None
    ) -> ViewGeometry:
        """Depth and rays of (B, V, 3, H, W) images in [0, 1], with or without known cameras."""
        levels = self.encode(images, cam_from_world=cam_from_world, K=K)
        return self.geometry(levels, self.encoder.grid(images.shape[-2], images.shape[-1]))


def relative_cameras(cam_from_world: Tensor) -> tuple[Tensor, Tensor]:
    """``cam_from_world`` (B, V, 4, 4) as the camera encoder was trained on them, and the unit (B,).

    The first view's frame becomes the world, and the unit the median distance of the centres from
    it (at least 0.1, so that a camera that only turns stays finite).
    """
    relative = cam_from_world.double() @ torch.linalg.inv(cam_from_world[:, :1].double())
    centres = -(relative[..., :3, :3].transpose(-1, -2) @ relative[..., :3, 3:])[..., 0]
    unit = torch.linalg.norm(centres, dim=-1).median(dim=1).values.clamp_min(0.1)
    scaled = relative.clone()
    scaled[..., :3, 3] = relative[..., :3, 3] / unit[:, None, None]
    return scaled.to(cam_from_world.dtype), unit.to(cam_from_world.dtype)


@dataclass(frozen=True)
class Released:
    """A released model."""

    config: DepthAnythingConfig  # its dimensions
    licence: str  # of its weights


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
    """Names of the one LayerNorm that the four ray outputs share; files hold it under one name."""
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
    # With ``model.safetensors`` of DA3-SMALL, -BASE or -LARGE, or a GeoVerse folder.
    folder: Path | str,
    *,
    device: torch.device | str = "cpu",  # of the weights
    # Of the autocast that it is run in, see ``DepthAnything3.hold_in``.
    dtype: torch.dtype = torch.float32,
) -> DepthAnything3:
    """The network, strictly loaded, frozen, in evaluation mode."""
    path = find_weights(folder)
    if path.name == GEOVERSE_FILE:
        place = path.with_name(GEOVERSE_CONFIG)
        config = read_model_config(DepthAnythingConfig, place, field="geometry")
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
    with shapes_alone():
        network = DepthAnything3(config)
    bad = not_finite(tensors)
    if bad is not None:
        raise CheckpointError(f"{path}: {bad} holds values that are not finite")
    load(network, tensors, where=path)
    network.hold_in(dtype)
    return network.requires_grad_(False).eval().to(device)
