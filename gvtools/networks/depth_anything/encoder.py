"""Depth Anything 3's backbone, split at the synthesis boundary, and its camera tokens.

``encode`` runs the blocks up to a given one and keeps the taps; ``propagate`` runs the rest from
features that a denoiser made. Blocks alternate from ``alternate_from`` on: even ones attend within
a view, odd ones across all views. A tap is the concatenation of the last local state and the
current state (2 x width channels), *raw*: the final LayerNorm is not applied, because it cannot be
undone and the re-run needs the state before it. ``normed`` applies it to the half that has it.

Parameter names are those of the published checkpoints (``norm1``, ``attn.qkv``, ``ls1.gamma`` ...).
Source: DINOv2 (Oquab et al. 2023) with the query/key norm and 2-D rotary positions of Depth
Anything 3 (Lin et al. 2025).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gvtools.errors import ShapeError
from gvtools.networks.compute import Recomputing, RememberedTable, attend, constant


@dataclass(frozen=True)
class RotaryTable:
    """Cosines and sines of 2-D rotary positions, computed once for all blocks of a pass."""

    cos: Tensor  # (T, 2, head_dim / 4) of each token: axis y, then axis x
    sin: Tensor  # likewise

    @classmethod
    def of(cls, positions: Tensor, head_dim: int, *, base: float = 100.0) -> RotaryTable:
        """The table of (T, 2) positions, y before x; angles are computed in float32."""
        frequencies = head_dim // 4
        exponent = torch.arange(frequencies, device=positions.device) / frequencies
        angle = positions.float()[:, :, None] * base**-exponent
        return cls(angle.cos(), angle.sin())

    def rotate(self, x: Tensor) -> Tensor:
        """(B, heads, T, head_dim) rotated; the pairs of an axis are its two halves."""
        first, second = x.unflatten(-1, (2, 2, -1)).unbind(-2)
        cos, sin = self.cos.to(x.dtype), self.sin.to(x.dtype)
        rotated = torch.stack((first * cos - second * sin, second * cos + first * sin), dim=-2)
        return rotated.flatten(-3)


class Attention(nn.Module):
    """Multi-head self-attention, optionally with a LayerNorm over each head's queries and keys."""

    def __init__(self, width: int, heads: int, *, qk_norm: bool = False) -> None:
        super().__init__()
        self.heads = heads
        head_dim = width // heads
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm: nn.Module = nn.LayerNorm(head_dim) if qk_norm else nn.Identity()
        self.k_norm: nn.Module = nn.LayerNorm(head_dim) if qk_norm else nn.Identity()
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, rotary: RotaryTable | None = None) -> Tensor:
        """(B, T, width) to the same; ``rotary`` has the positions of the T tokens."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = self.q_norm(q), self.k_norm(k)
        if rotary is not None:
            q, k = rotary.rotate(q), rotary.rotate(k)
        return self.proj(attend(q, k, v).transpose(1, 2).flatten(2))


class LayerScale(nn.Module):
    """One learned factor a channel."""

    def __init__(self, width: int, initial: float = 1.0) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), initial))

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) scaled."""
        return x * self.gamma


class Mlp(nn.Module):
    """Two linear layers with the exact GELU between them."""

    def __init__(self, width: int, hidden: int, out: int | None = None) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.act = nn.GELU()
        self.fc2 = nn.Linear(hidden, out or width)

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) to (..., out)."""
        return self.fc2(self.act(self.fc1(x)))


class TransformerBlock(nn.Module):
    """Pre-norm transformer block with layer scale."""

    def __init__(
        self,
        width: int,  # channels
        heads: int,  # divides ``width``
        *,
        mlp_ratio: float = 4.0,  # hidden width of the MLP over ``width``
        qk_norm: bool = False,  # see ``Attention``
        # Of the two LayerNorms: 1e-6 in the backbone, 1e-5 in the camera encoder.
        eps: float = 1e-6,
        layer_scale: float = 1.0,  # initial factor of both branches
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=eps)
        self.attn = Attention(width, heads, qk_norm=qk_norm)
        self.ls1 = LayerScale(width, layer_scale)
        self.norm2 = nn.LayerNorm(width, eps=eps)
        self.mlp = Mlp(width, int(width * mlp_ratio))
        self.ls2 = LayerScale(width, layer_scale)

    def forward(self, x: Tensor, rotary: RotaryTable | None = None) -> Tensor:
        """(B, T, width) to the same."""
        x = x + self.ls1(self.attn(self.norm1(x), rotary))
        return x + self.ls2(self.mlp(self.norm2(x)))


POSE_CHANNELS = 9


class CameraEncoder(nn.Module):
    """Known cameras to the tokens that replace the learned camera token."""

    def __init__(
        self, width: int, heads: int = 16, depth: int = 4, *, layer_scale: float = 0.01
    ) -> None:
        super().__init__()
        self.pose_branch = Mlp(POSE_CHANNELS, width // 2, width)
        self.token_norm = nn.LayerNorm(width)
        self.trunk = nn.Sequential(
            *(
                TransformerBlock(width, heads, eps=1e-5, layer_scale=layer_scale)
                for _ in range(depth)
            )
        )
        self.trunk_norm = nn.LayerNorm(width)

    def forward(self, cam_from_world: Tensor, K: Tensor, size: tuple[int, int]) -> Tensor:
        """(B, V, width) tokens of cameras (B, V, 4, 4) with K (B, V, 3, 3) in px of the input.

        A trained model takes ``relative_cameras``.
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
    """(..., 3, 3) rotations to (..., 4) unit quaternions, scalar last and not negative."""
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


IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


# Numbers of a ray: direction, origin, moment.
RAY = 9
LENGTH_GAIN = 6.0


@dataclass(frozen=True)
class EncoderConfig:
    """Dimensions of the backbone; the defaults are Depth Anything 3 Base."""

    width: int = 768  # channels of a token
    depth: int = 12  # number of blocks
    heads: int = 12  # attention heads
    mlp_ratio: float = 4.0  # hidden width of the MLPs over ``width``
    patch: int = 14  # patch edge, px
    base_grid: int = 37  # edge of the learned position table, patches
    # From this block on, odd blocks are global; the camera token enters here.
    alternate_from: int = 4
    qk_norm_from: int = 4  # from this block on, queries and keys are normed
    rotary_from: int = 4  # from this block on, attention has rotary positions
    # The blocks whose features are levels 0 to 3; all but none of them odd.
    taps: tuple[int, ...] = (5, 7, 9, 11)
    boundary: int = 1  # the level at which features are generated (the paper's b1)
    norm_eps: float = 1e-6  # of the LayerNorms within the blocks
    # The rays of known cameras are added to the patch tokens (not in Depth Anything 3, which has a
    # camera token alone).
    rays: bool = False

    @property
    def channels(self) -> int:
        """Channels of a tapped level: local and current state."""
        return 2 * self.width


class PatchEmbed(nn.Module):
    """Non-overlapping patches to tokens."""

    def __init__(self, channels: int, width: int, patch: int = 1) -> None:
        super().__init__()
        self.proj = nn.Conv2d(channels, width, kernel_size=patch, stride=patch)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, H, W) to (B, H/patch * W/patch, width), row-major."""
        return self.proj(x).flatten(2).transpose(1, 2)


class DepthAnythingBackbone(Recomputing):
    """The vision transformer. The first view's frame is the frame of the predicted rays."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.camera_token = nn.Parameter(torch.randn(1, 2, width) * 0.02)
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.base_grid**2, width))
        self._resized = RememberedTable()
        self.patch_embed = PatchEmbed(3, width, config.patch)
        self.blocks = nn.ModuleList(
            TransformerBlock(
                width,
                config.heads,
                mlp_ratio=config.mlp_ratio,
                qk_norm=index >= config.qk_norm_from,
                eps=config.norm_eps,
            )
            for index in range(config.depth)
        )
        self.norm = nn.LayerNorm(width)
        self.ray_embed = _ray_embedder(width) if config.rays else None

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Patches (rows, columns) of an image of this size."""
        patch = self.config.patch
        if height % patch or width % patch or height <= 0 or width <= 0:
            raise ShapeError(
                f"images of {width}x{height} pixels; expected sides that are multiples of {patch}: "
                f"resize to {max(1, round(width / patch)) * patch}x"
                f"{max(1, round(height / patch)) * patch}"
            )
        return height // patch, width // patch

    def encode(
        self,
        images: Tensor,  # (B, V, 3, H, W), ImageNet-normalised
        *,
        # How many levels; None for all. Blocks after the last tap are not run.
        levels: int | None = None,
        # (B, V, width) from the camera encoder; the learned ones without.
        camera_token: Tensor | None = None,
        # (B, V, N, 9) of ``patch_rays``, where the configuration has them.
        rays: Tensor | None = None,
    ) -> list[Tensor]:  # A (B, V, 1 + N, 2 width) tensor a level
        """Features of the first levels, raw, token 0 included."""
        batch, views = images.shape[:2]
        grid = self.grid(images.shape[-2], images.shape[-1])
        x = self.patch_embed(images.flatten(0, 1))
        if self.ray_embed is not None and rays is not None:
            x = x + self.ray_embed(rays.flatten(0, 1).to(x.dtype))
        x = torch.cat((self.cls_token.expand(len(x), -1, -1), x), dim=1) + self._positions(grid)
        x = x.unflatten(0, (batch, views))
        taps = self.config.taps[:levels]
        return self._run(x, grid, 0, taps=taps, camera_token=camera_token)

    def propagate(self, level: Tensor, grid: tuple[int, int]) -> list[Tensor]:
        """(B, V, 1 + N, 2 width) of each level after the boundary, from that level's raw features.

        Only their second half (the current state) is used: a local block follows and replaces the
        first.
        """
        taps = self.config.taps[self.config.boundary :]
        state = level[..., self.config.width :]
        return self._run(state, grid, taps[0] + 1, taps=taps[1:], camera_token=None)

    def normed(self, level: Tensor) -> Tensor:
        """What the heads receive of a raw (..., 2 width) level: [local, LayerNorm(current)]."""
        local, current = level.chunk(2, dim=-1)
        return torch.cat((local, self.norm(current)), dim=-1)

    def _run(
        self,
        x: Tensor,
        grid: tuple[int, int],
        start: int,
        *,
        taps: tuple[int, ...],
        camera_token: Tensor | None,
    ) -> list[Tensor]:
        """Blocks ``start`` to the last tap on (B, V, 1 + N, width); the tapped features."""
        config = self.config
        batch, views = x.shape[:2]
        within, across = self._rotary(grid, views, x.device)
        found: list[Tensor] = []
        local = x
        for index in range(start, taps[-1] + 1 if taps else start):
            block = self.blocks[index]
            if index == config.alternate_from:
                x = torch.cat((self._camera_tokens(x, camera_token), x[:, :, 1:]), dim=2)
            rotary = index >= config.rotary_from
            if index >= config.alternate_from and index % 2 == 1:
                table = across if rotary else None
                x = self.layer(block, x.flatten(1, 2), table).unflatten(1, (views, -1))
            else:
                table = within if rotary else None
                x = self.layer(block, x.flatten(0, 1), table).unflatten(0, (batch, views))
                local = x
            if index in taps:
                found.append(torch.cat((local, x), dim=-1))
        return found

    def _camera_tokens(self, x: Tensor, given: Tensor | None) -> Tensor:
        """(B, V, 1, width): the given tokens, or the learned ones: reference, others."""
        batch, views = x.shape[:2]
        if given is not None:
            return given.to(x.dtype)[:, :, None]
        reference, other = self.camera_token.to(x.dtype).split(1, dim=1)
        tokens = torch.cat((reference, other.expand(-1, views - 1, -1)), dim=1)
        return tokens.expand(batch, -1, -1)[:, :, None]

    def _rotary(
        self, grid: tuple[int, int], views: int, device: torch.device
    ) -> tuple[RotaryTable, RotaryTable]:
        """Positions within a view, (row, column) + 1; across views all patches stand at (1, 1)."""
        rows, columns = torch.meshgrid(
            torch.arange(1, grid[0] + 1, device=device),
            torch.arange(1, grid[1] + 1, device=device),
            indexing="ij",
        )
        patches = torch.stack((rows.flatten(), columns.flatten()), dim=1)
        special = patches.new_zeros((1, 2))
        head_dim = self.config.width // self.config.heads
        within = torch.cat((special, patches))
        across = torch.cat((special, torch.ones_like(patches))).repeat(views, 1)
        return RotaryTable.of(within, head_dim), RotaryTable.of(across, head_dim)

    def _positions(self, grid: tuple[int, int]) -> Tensor:
        """(1, 1 + N, width): the learned position table on this grid.

        The published weights were trained with DINOv2's scale factor (grid + 0.1) / base, not with
        the exact size; the difference is visible in the outputs.
        """
        base = self.config.base_grid
        if grid == (base, base):
            return self.pos_embed
        return self._resized(grid, self.pos_embed, lambda: self._interpolated(grid))

    def _interpolated(self, grid: tuple[int, int]) -> Tensor:
        base = self.config.base_grid
        token, patches = self.pos_embed.float().split((1, base * base), dim=1)
        table = patches.transpose(1, 2).unflatten(2, (base, base))
        factor = [(side + 0.1) / base for side in grid]
        table = F.interpolate(table, scale_factor=factor, mode="bicubic", antialias=False)
        return torch.cat((token, table.flatten(2).transpose(1, 2)), dim=1).to(self.pos_embed.dtype)


def _ray_embedder(width: int) -> nn.Linear:
    """Rays as large as what pictures add to a token: the smaller, the later they are learned."""
    embedder = nn.Linear(RAY, width)
    with torch.no_grad():
        nn.init.normal_(embedder.weight)
        embedder.weight[:, 3:] *= LENGTH_GAIN
        nn.init.zeros_(embedder.bias)
    return embedder


def patch_rays(
    cam_from_world: Tensor, K: Tensor, grid: tuple[int, int], *, size: tuple[int, int]
) -> Tensor:
    """(B, V, N, 9): direction (z = 1 in the camera), origin and moment of patches' middle rays."""
    y = (torch.arange(grid[0], device=K.device, dtype=K.dtype) + 0.5) * (size[0] / grid[0])
    x = (torch.arange(grid[1], device=K.device, dtype=K.dtype) + 0.5) * (size[1] / grid[1])
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    pixel = torch.stack((columns, rows, torch.ones_like(rows)), dim=-1).flatten(0, 1)
    turn = cam_from_world[..., :3, :3].mT
    direction = pixel @ (turn @ torch.linalg.inv(K)).mT
    origin = -(turn @ cam_from_world[..., :3, 3:])[..., 0][:, :, None].expand_as(direction)
    return torch.cat((direction, origin, torch.linalg.cross(origin, direction)), dim=-1)


def normalise_imagenet(images: Tensor) -> Tensor:
    """(..., 3, H, W) in [0, 1] to ImageNet's mean 0 and deviation 1."""
    mean, std = (constant(c, images)[:, None, None] for c in (IMAGENET_MEAN, IMAGENET_STD))
    return (images - mean) / std
