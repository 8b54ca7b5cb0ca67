"""Camera conditions of the denoisers: normalised poses, Plücker maps and projective positions.

Poses and maps follow Geometric Latent Diffusion, for the weights' sake: poses are re-based to the
last view, translations are scaled by the largest component, and a pixel's ray passes through
(column - 0.5, row + 0.5).

Positions are PRoPE (Li et al., "Cameras as Relative Positional Encoding", 2025). A camera's matrix
is P = lift(K) · cam_from_world, 4x4, with K in shares of the image about its centre. The first half
of a head's channels is cut into groups of four, and each group of a token is multiplied by its
view's matrix: queries by Pᵀ, keys and values by P⁻¹, the result by P. A score then holds P_i P_j⁻¹
alone, whatever the world frame. The second half carries rotary positions within the image: a
quarter for x, a quarter for y, pairs formed by the two halves of a quarter. GLD's recorded outputs
have K itself in the place of K⁻¹ (``invert_K=False``): still independent of the world frame, but a
token no longer meets its own view's tokens through the identity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gvtools.networks.depth_anything.geometry_head import rigid

# (x, y) added to column and row. The half pixel to the left is an oddity of the published weights.
GLD_PIXEL_OFFSET = (-0.5, 0.5)
CENTRED = (0.5, 0.5)
# Centres nearer to each other than this many roundings of their coordinates coincide.
COINCIDENT = 8
GROUP = 4
# Half of the channels in groups of four, and two rotary quarters of pairs.
HEAD_MULTIPLE = 8
ROTARY_BASE = 100.0  # of the rotary frequencies


@dataclass(frozen=True, eq=False)
class CameraCondition:
    """What a denoiser is told of B x V cameras."""

    map: Tensor  # (B, V, 7, H, W): 0 on context views and 1 on the others, then the Plücker map
    cam_from_world: Tensor  # (B, V, 4, 4), scaled, not re-based: PRoPE sees relative poses alone
    K: Tensor  # (B, V, 3, 3), pixels of an image of ``size``
    size: tuple[int, int]  # (H, W), pixels
    scale: Tensor  # (B,), scaled units per scene unit
    context: int  # number of context views, which come first

    def unconditional(self, mode: str = "new") -> CameraCondition:
        """The condition without cameras, for classifier-free guidance; the view mask stays.

        The published models know three: "new" drops poses and K (level 1), "old" the poses (the
        cascade, as it is evaluated), "old_train" K (the cascade, as it is trained).
        """
        dropped = {"new": (True, True), "old": (True, False), "old_train": (False, True)}
        no_poses, no_K = dropped[mode]
        pose, K = self.cam_from_world, self.K
        return replace(
            self,
            map=torch.cat((self.map[:, :, :1], torch.zeros_like(self.map[:, :, 1:])), dim=2),
            cam_from_world=_identity(pose) if no_poses else pose,
            K=_identity(K) if no_K else K,
        )


def camera_condition(
    world_from_cam: Tensor,  # (B, V, 4, 4) rigid, OpenCV, scene units
    K: Tensor,  # (B, V, 3, 3), pixels
    size: tuple[int, int],  # (H, W) of the images, pixels
    *,
    context: int,  # number of context views
    reference: int = -1,  # view whose frame the map is in
    pixel_offset: tuple[float, float] = GLD_PIXEL_OFFSET,  # (x, y) added to column and row
) -> CameraCondition:
    """The condition of B x V cameras, context views first."""
    rebased, scale = normalised_poses(world_from_cam, reference=reference)
    views = rebased.shape[1]
    rays = plucker_map(rebased, K, size, pixel_offset=pixel_offset)
    mask = (torch.arange(views, device=rays.device) >= context).to(rays.dtype)
    mask = mask.view(1, views, 1, 1, 1).expand(len(rays), views, 1, *size)
    rotation = world_from_cam[..., :3, :3].to(rebased.dtype).mT
    shift = -_product(rotation, world_from_cam[..., :3, 3:].to(rebased.dtype))[..., 0]
    pose = rigid(rotation, shift * scale[:, None, None])
    map_ = torch.cat((mask, rays), dim=2)
    return CameraCondition(map_, pose, K.to(rays.dtype), (size[0], size[1]), scale, context)


def normalised_poses(world_from_cam: Tensor, *, reference: int = -1) -> tuple[Tensor, Tensor]:
    """(B, V, 4, 4) poses in the frame of one view, the largest component of a centre 1; scale (B,).

    Differences of centres are taken before anything is rotated, so that views far from the world's
    origin keep their digits. Where all centres coincide, translations are 0 and the scale 1.
    """
    world_from_cam = world_from_cam.to(_precise(world_from_cam))
    rotation, centre = world_from_cam[..., :3, :3], world_from_cam[..., :3, 3:]
    base = rotation[:, reference, None].mT
    offset = _product(base, centre - centre[:, reference, None])[..., 0]
    farthest = offset.abs().amax(dim=(1, 2))
    rounding = COINCIDENT * torch.finfo(centre.dtype).eps * centre.abs().amax(dim=(1, 2, 3))
    apart = farthest > rounding
    scale = torch.where(apart, 1 / (farthest + 1e-8), torch.ones_like(farthest))
    offset = offset * (scale * apart)[:, None, None]
    return rigid(_product(base, rotation), offset), scale


def plucker_map(
    world_from_cam: Tensor,  # (B, V, 4, 4) rigid, OpenCV
    K: Tensor,  # (B, V, 3, 3), pixels of an image of ``size``
    size: tuple[int, int],  # (H, W), pixels
    *,
    pixel_offset: tuple[float, float] = CENTRED,  # (x, y) added to column and row
) -> Tensor:  # (B, V, 6, H, W)
    """Plücker ray map: unit direction d and moment o x d of every pixel's ray, world frame."""
    dtype = torch.promote_types(_precise(world_from_cam), K.dtype)
    world_from_cam, K = world_from_cam.to(dtype), K.to(dtype)
    height, width = size
    x = torch.arange(width, dtype=K.dtype, device=K.device) + pixel_offset[0]
    y = torch.arange(height, dtype=K.dtype, device=K.device) + pixel_offset[1]
    pixel = torch.stack(
        (x.expand(height, width), y[:, None].expand(height, width), x.new_ones(height, width))
    )
    # What ``inv`` does, without asking the device whether it could.
    through = _product(world_from_cam[..., :3, :3], torch.linalg.inv_ex(K).inverse)
    direction = _product(through, pixel.flatten(1))
    # Never 0: z is 1 before the rotation. Torch's own norm is slow over a dimension in the middle.
    direction = (direction / direction.square().sum(dim=2, keepdim=True).sqrt()).unflatten(-1, size)
    centre = world_from_cam[..., :3, 3, None, None].expand_as(direction)
    return torch.cat((direction, torch.linalg.cross(centre, direction, dim=2)), dim=2)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """The product a @ b in the operands' precision, whatever autocast would have."""
    with torch.autocast(a.device.type, enabled=False):
        return a @ b


def _precise(tensor: Tensor) -> torch.dtype:
    return torch.promote_types(tensor.dtype, torch.float32)


def _identity(like: Tensor) -> Tensor:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device).expand_as(like)


class Projective:
    """The encoding of V cameras over one token grid, built once for all layers of a pass.

    Matrices and angles are float32 (float64 for float64 cameras) whatever the tokens are; the
    tokens' dtype is that of the result. ``matrix`` and ``key_matrix`` (B, V, 4, 4) are P and its
    inverse.
    """

    def __init__(
        self,
        # (B, V, 4, 4) rigid, OpenCV; any scale, the same for all views of a sample.
        cam_from_world: Tensor,
        K: Tensor,  # (B, V, 3, 3) pixels of an image of ``size``; skew is not used
        size: tuple[int, int],  # (H, W), pixels, by which K is normalised
        *,
        grid: tuple[int, int],  # (h, w) tokens of a view, row-major
        head_dim: int,  # channels of an attention head, a multiple of 8
        # (y, x) tokens of another grid per token of this one: keys that lie on a coarser grid get
        # the positions of their centres on the queries' grid.
        position_scale: tuple[float, float] = (1.0, 1.0),
        # False for keys and values as in GLD's recorded outputs; see the module.
        invert_K: bool = True,
    ) -> None:
        dtype = _precise(cam_from_world)
        self.grid = grid
        self.views = cam_from_world.shape[1]
        self.head_dim = head_dim
        self.matrix, self.key_matrix = projection_matrices(
            cam_from_world.to(dtype), K, size=size, invert_K=invert_K
        )
        # Of the tokens' positions, (h*w, 2, head_dim / 8): axis x, then axis y.
        kind: dict[str, Any] = {"dtype": dtype, "device": self.matrix.device}
        rows, columns = (
            (torch.arange(count, **kind) + 0.5) * factor - 0.5
            for count, factor in zip(grid, position_scale, strict=True)
        )
        position = torch.stack((columns.repeat(grid[0]), rows.repeat_interleave(grid[1])), dim=-1)
        exponent = torch.arange(head_dim // 8, **kind) / (head_dim // 8)
        angle = position[..., None] * ROTARY_BASE**-exponent
        self.cos, self.sin = angle.cos(), angle.sin()
        # As wide as half a head, so that whole rows are multiplied: rows of four are slow.
        self._query, self._key, self._output = (
            _blocks(right, head_dim // 2)
            for right in (self.matrix, self.key_matrix.mT, self.matrix.mT)
        )
        self._cos = torch.stack((self.cos, self.cos), dim=-2).flatten(-3)
        self._sin = torch.stack((self.sin, -self.sin), dim=-2).flatten(-3)

    def query(self, q: Tensor) -> Tensor:
        """(B, heads, V*h*w, head_dim) queries, encoded."""
        return self._apply(q, self._query, 1)

    def key(self, k: Tensor) -> Tensor:
        """(B, heads, V*h*w, head_dim) keys, encoded."""
        return self._apply(k, self._key, 1)

    value = key

    def output(self, o: Tensor) -> Tensor:
        """(B, heads, V*h*w, head_dim) results of attention, taken back to each token's frame."""
        return self._apply(o, self._output, -1)

    def _apply(self, x: Tensor, blocks: Tensor, turn: int) -> Tensor:
        """Half a head times ``blocks`` (B, V, half, half), the other half rotated by +-1 turn."""
        tokens = self.grid[0] * self.grid[1]
        dtype = torch.promote_types(x.dtype, blocks.dtype)
        # Under autocast the products would be rounded to half precision, and P P⁻¹ with them.
        with torch.autocast(x.device.type, enabled=False):
            projected, turned = x.unflatten(2, (self.views, tokens)).to(dtype).chunk(2, dim=-1)
            projected = projected @ blocks.to(dtype)[:, None]
            # The other of each rotary pair.
            x1, x2, y1, y2 = turned.chunk(4, dim=-1)
            other = torch.cat((x2, x1, y2, y1), dim=-1)
            turned = torch.addcmul(turned * self._cos, other, self._sin, value=turn)
        return torch.cat((projected.to(x.dtype), turned.to(x.dtype)), -1).flatten(2, 3)


def projection_matrices(
    cam_from_world: Tensor, K: Tensor, *, size: tuple[int, int], invert_K: bool = True
) -> tuple[Tensor, Tensor]:  # Two (..., 4, 4)
    """P = lift(K) · cam_from_world (..., 4, 4) and its inverse, with K in shares of the image.

    fx / W, fy / H, cx / W - 0.5, cy / H - 0.5. Written out row by row: no matrix product whose
    precision a backend may lower, no general inversion. ``invert_K`` False leaves K in the second.
    """
    K = K.to(cam_from_world.dtype)
    height, width = size
    fx, fy = K[..., 0, 0, None] / width, K[..., 1, 1, None] / height
    cx, cy = K[..., 0, 2, None] / width - 0.5, K[..., 1, 2, None] / height - 0.5
    x, y, z, last = cam_from_world.unbind(-2)
    matrix = torch.stack((fx * x + cx * z, fy * y + cy * z, z, last), dim=-2)

    rotation, translation = cam_from_world[..., :3, :3], cam_from_world[..., :3, 3]
    centre = -(rotation * translation[..., None]).sum(-2)
    x, y, z = torch.nn.functional.pad(rotation, (0, 1)).unbind(-2)  # columns of the inverse
    if invert_K:
        fx, fy, cx, cy = 1 / fx, 1 / fy, -cx / fx, -cy / fy
    last = torch.cat((centre, torch.ones_like(centre[..., :1])), -1)
    columns = (fx * x, fy * y, cx * x + cy * y + z, last)
    return matrix, torch.stack(columns, dim=-1)


def _blocks(right: Tensor, size: int) -> Tensor:
    """(..., 4, 4) to (..., size, size) with as many copies along the diagonal as there is room."""
    eye = torch.eye(size // GROUP, dtype=right.dtype, device=right.device)
    blocks = eye[:, None, :, None] * right[..., None, :, None, :]
    return blocks.flatten(-4, -3).flatten(-2, -1)
