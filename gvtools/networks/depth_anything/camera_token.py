"""Depth Anything 3's camera encoder and decoder: poses to camera tokens and back."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gvtools.networks.depth_anything.vit import Block, Mlp

POSE_CHANNELS = 9


class CameraEncoder(nn.Module):
    """Known cameras to the tokens that replace the learned camera token.

    Args:
        width: channels of a token.
        heads: of the attention over views.
        depth: number of blocks.
        layer_scale: initial factor of the blocks' branches.
    """

    def __init__(
        self, width: int, heads: int = 16, depth: int = 4, *, layer_scale: float = 0.01
    ) -> None:
        super().__init__()
        self.pose_branch = Mlp(POSE_CHANNELS, width // 2, width)
        self.token_norm = nn.LayerNorm(width)
        self.trunk = nn.Sequential(
            *(Block(width, heads, eps=1e-5, layer_scale=layer_scale) for _ in range(depth))
        )
        self.trunk_norm = nn.LayerNorm(width)

    def forward(self, cam_from_world: Tensor, K: Tensor, size: tuple[int, int]) -> Tensor:
        """Tokens of cameras.

        Args:
            cam_from_world: (B, V, 4, 4), OpenCV, relative to the reference view for a trained
                model (``DepthAnything3.relative_cameras``).
            K: (B, V, 3, 3), px of the network's input.
            size: (H, W) of the network's input.

        Returns:
            (B, V, width).
        """
        encoding = encode_cameras(cam_from_world, K, size)
        tokens = self.token_norm(self.pose_branch(encoding.to(self.token_norm.weight.dtype)))
        return self.trunk_norm(self.trunk(tokens))


class CameraDecoder(nn.Module):
    """The camera token of the last level to a pose encoding.

    Of no use on generated features, whose camera token is a stand-in: there poses come from rays.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.backbone = nn.Sequential(
            nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU()
        )
        self.fc_t = nn.Linear(channels, 3)
        self.fc_qvec = nn.Linear(channels, 4)
        self.fc_fov = nn.Sequential(nn.Linear(channels, 2), nn.ReLU())

    def forward(self, token: Tensor) -> Tensor:
        """(B, V, channels) raw token 0 to (B, V, 9): T, quaternion xyzw, fov_h, fov_w (rad)."""
        features = self.backbone(token)
        parts = (self.fc_t(features), self.fc_qvec(features), self.fc_fov(features))
        return torch.cat(parts, dim=-1)


def encode_cameras(cam_from_world: Tensor, K: Tensor, size: tuple[int, int]) -> Tensor:
    """(B, V, 9): camera centre, quaternion xyzw of ``world_from_cam``, fov_h and fov_w in rad."""
    rotation = cam_from_world[..., :3, :3].transpose(-1, -2)
    centre = -(rotation @ cam_from_world[..., :3, 3:])[..., 0]
    fov_h = 2 * torch.atan(size[0] / 2 / K[..., 1, 1])
    fov_w = 2 * torch.atan(size[1] / 2 / K[..., 0, 0])
    return torch.cat((centre, quaternion_xyzw(rotation), fov_h[..., None], fov_w[..., None]), -1)


def quaternion_xyzw(rotation: Tensor) -> Tensor:
    """(..., 3, 3) rotations to (..., 4) unit quaternions, scalar last and not negative.

    Of the four algebraically equal forms, the one with the largest divisor is taken.
    """
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squared = torch.stack(
        (1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz), dim=-1
    )
    a, b, c = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    x, y, z = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    sx, sy, sz, sw = squared.unbind(-1)
    rows = torch.stack((sx, a, b, x, a, sy, c, y, b, c, sz, z, x, y, z, sw), dim=-1)
    best = squared.argmax(dim=-1)[..., None, None].expand(*squared.shape[:-1], 1, 4)
    chosen = torch.gather(rows.unflatten(-1, (4, 4)), -2, best)[..., 0, :]
    quaternion = chosen / torch.linalg.norm(chosen, dim=-1, keepdim=True)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
