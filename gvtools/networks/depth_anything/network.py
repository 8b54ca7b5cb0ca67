"""Depth Anything 3 (Small, Base and smaller): backbone, geometry head, camera encoder and decoder.

Parameter names are those of the published ``model.safetensors`` without their prefix ``model.``.
Source: Depth Anything 3, Lin et al. 2025.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from gvtools.networks.depth_anything.camera_token import CameraDecoder, CameraEncoder
from gvtools.networks.depth_anything.encoder import (
    Backbone,
    EncoderConfig,
    imagenet_normalised,
    patch_rays,
)
from gvtools.networks.depth_anything.geometry_head import (
    Geometry,
    GeometryHead,
    GeometryHeadConfig,
)
from gvtools.networks.precision import hold_in


@dataclass(frozen=True)
class DepthAnythingConfig:
    """Dimensions of the whole network; the defaults are Depth Anything 3 Base.

    Attributes:
        encoder: of the backbone.
        head: of the geometry head.
        camera_heads: attention heads of the camera encoder.
        camera_depth: blocks of the camera encoder.
        camera_layer_scale: initial layer scale of the camera encoder.
    """

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    head: GeometryHeadConfig = field(default_factory=GeometryHeadConfig)
    camera_heads: int = 16
    camera_depth: int = 4
    camera_layer_scale: float = 0.01


class _Named(nn.Module):
    """Holds the backbone under the name that the checkpoints give it."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.pretrained = Backbone(config)


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
        """Keep products' weights in autocast's type, see ``precision``; the head is float32."""
        hold_in(dtype, self.backbone, self.cam_enc, self.cam_dec)

    @property
    def encoder(self) -> Backbone:
        """The backbone itself."""
        return self.backbone.pretrained

    def encode(
        self,
        images: Tensor,
        *,
        levels: int | None = None,
        cam_from_world: Tensor | None = None,
        K: Tensor | None = None,
    ) -> list[Tensor]:
        """Raw features of the first ``levels`` levels, token 0 included.

        Args:
            images: (B, V, 3, H, W) in [0, 1].
            levels: how many; None for all four.
            cam_from_world: (B, V, 4, 4) cameras, when they are known; with ``K``.
            K: (B, V, 3, 3), px of ``images``.
        """
        token = rays = None
        if cam_from_world is not None and K is not None:
            size = (images.shape[-2], images.shape[-1])
            token = self.cam_enc(cam_from_world, K, size)
            if self.config.encoder.rays:
                rays = patch_rays(cam_from_world, K, self.encoder.grid(*size), size=size)
        normalised = imagenet_normalised(images).to(self.encoder.cls_token.dtype)
        return self.encoder.encode(normalised, levels=levels, camera_token=token, rays=rays)

    def geometry(
        self, levels: list[Tensor], grid: tuple[int, int], *, views_at_once: int = 8
    ) -> Geometry:
        """Depth and rays of four raw levels, token 0 included."""
        normed = [self.encoder.normed(level[:, :, 1:]) for level in levels]
        return self.head(normed, grid, views_at_once=views_at_once)

    def forward(
        self, images: Tensor, *, cam_from_world: Tensor | None = None, K: Tensor | None = None
    ) -> Geometry:
        """Depth and rays of (B, V, 3, H, W) images in [0, 1], with or without known cameras."""
        levels = self.encode(images, cam_from_world=cam_from_world, K=K)
        return self.geometry(levels, self.encoder.grid(images.shape[-2], images.shape[-1]))


def relative_cameras(cam_from_world: Tensor) -> tuple[Tensor, Tensor]:
    """Cameras as the camera encoder was trained on them.

    The first view's frame becomes the world, and the unit the median distance of the centres from
    it (at least 0.1, so that a camera that only turns stays finite).

    Args:
        cam_from_world: (B, V, 4, 4).

    Returns:
        (B, V, 4, 4) relative ``cam_from_world``, and the (B,) unit in the input's units.
    """
    relative = cam_from_world.double() @ torch.linalg.inv(cam_from_world[:, :1].double())
    centres = -(relative[..., :3, :3].transpose(-1, -2) @ relative[..., :3, 3:])[..., 0]
    unit = torch.linalg.norm(centres, dim=-1).median(dim=1).values.clamp_min(0.1)
    scaled = relative.clone()
    scaled[..., :3, 3] = relative[..., :3, 3] / unit[:, None, None]
    return scaled.to(cam_from_world.dtype), unit.to(cam_from_world.dtype)
