"""Camera conditions of the denoisers: normalised poses, Plücker maps and the view mask.

Geometric Latent Diffusion's convention, for the weights' sake: poses are re-based to the last view
of the list, translations are scaled by the largest component, and a pixel's ray passes through
(column - 0.5, row + 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

# (x, y) added to column and row. The half pixel to the left is an oddity of the published weights.
GLD_PIXEL_OFFSET = (-0.5, 0.5)
CENTRED = (0.5, 0.5)
# Centres nearer to each other than this many roundings of their coordinates coincide.
COINCIDENT = 8


@dataclass(frozen=True, eq=False)
class CameraCondition:
    """What a denoiser is told of B x V cameras.

    Attributes:
        map: (B, V, 7, H, W): 0 on context views and 1 on the others, then the Plücker map.
        cam_from_world: (B, V, 4, 4), scaled, not re-based: PRoPE sees relative poses alone.
        K: (B, V, 3, 3), pixels of an image of ``size``.
        size: (H, W), pixels.
        scale: (B,), scaled units per scene unit.
        context: number of context views, which come first.
    """

    map: Tensor
    cam_from_world: Tensor
    K: Tensor
    size: tuple[int, int]
    scale: Tensor
    context: int

    def unconditional(self, mode: str = "new") -> CameraCondition:
        """The condition without cameras, for classifier-free guidance; the view mask stays.

        The published models were trained and sampled with three versions of it:

        ===========  ==============  =============  =======================================
        mode         poses           K              model
        ===========  ==============  =============  =======================================
        "new"        identity        identity       level 1
        "old"        identity        kept           cascade, as its evaluation runs it
        "old_train"  kept            identity       cascade, as its training configuration
        ===========  ==============  =============  =======================================
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
    world_from_cam: Tensor,
    K: Tensor,
    size: tuple[int, int],
    *,
    context: int,
    reference: int = -1,
    pixel_offset: tuple[float, float] = GLD_PIXEL_OFFSET,
) -> CameraCondition:
    """The condition of B x V cameras, context views first.

    Args:
        world_from_cam: (B, V, 4, 4) rigid, OpenCV, scene units.
        K: (B, V, 3, 3), pixels.
        size: (H, W) of the images, pixels.
        context: number of context views.
        reference: view whose frame the map is in.
        pixel_offset: (x, y) added to column and row.
    """
    rebased, scale = normalised_poses(world_from_cam, reference=reference)
    views = rebased.shape[1]
    rays = plucker_map(rebased, K, size, pixel_offset=pixel_offset)
    mask = (torch.arange(views, device=rays.device) >= context).to(rays.dtype)
    mask = mask.view(1, views, 1, 1, 1).expand(len(rays), views, 1, *size)
    rotation = world_from_cam[..., :3, :3].to(rebased.dtype).mT
    shift = -_product(rotation, world_from_cam[..., :3, 3:].to(rebased.dtype))[..., 0]
    pose = _pose(rotation, shift * scale[:, None, None])
    map_ = torch.cat((mask, rays), dim=2)
    return CameraCondition(map_, pose, K.to(rays.dtype), (size[0], size[1]), scale, context)


def normalised_poses(world_from_cam: Tensor, *, reference: int = -1) -> tuple[Tensor, Tensor]:
    """Poses in the frame of one view, scaled so that the largest component of a centre is 1.

    Differences of centres are taken before anything is rotated, so that views far from the
    world's origin keep their digits. Where all centres coincide, nothing sets a scale: the
    translations are 0 and the scale is 1.

    Args:
        world_from_cam: (B, V, 4, 4) rigid, OpenCV, scene units.
        reference: the view that becomes the identity.

    Returns:
        world_from_cam (B, V, 4, 4), re-based and scaled, and the scale (B,).
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
    return _pose(_product(base, rotation), offset), scale


def plucker_map(
    world_from_cam: Tensor,
    K: Tensor,
    size: tuple[int, int],
    *,
    pixel_offset: tuple[float, float] = CENTRED,
) -> Tensor:
    """Plücker ray map: unit direction d and moment o x d of every pixel's ray, world frame.

    Args:
        world_from_cam: (B, V, 4, 4) rigid, OpenCV.
        K: (B, V, 3, 3), pixels of an image of ``size``.
        size: (H, W), pixels.
        pixel_offset: (x, y) added to column and row.

    Returns:
        (B, V, 6, H, W).
    """
    dtype = torch.promote_types(_precise(world_from_cam), K.dtype)
    world_from_cam, K = world_from_cam.to(dtype), K.to(dtype)
    height, width = size
    x = torch.arange(width, dtype=K.dtype, device=K.device) + pixel_offset[0]
    y = torch.arange(height, dtype=K.dtype, device=K.device) + pixel_offset[1]
    pixel = torch.stack(
        (x.expand(height, width), y[:, None].expand(height, width), x.new_ones(height, width))
    )
    through = _product(world_from_cam[..., :3, :3], torch.linalg.inv(K))
    direction = _product(through, pixel.flatten(1))
    # Never 0: z is 1 before the rotation. Torch's own norm is slow over a dimension in the middle.
    direction = (direction / direction.square().sum(dim=2, keepdim=True).sqrt()).unflatten(-1, size)
    centre = world_from_cam[..., :3, 3, None, None].expand_as(direction)
    return torch.cat((direction, torch.linalg.cross(centre, direction, dim=2)), dim=2)


def _pose(rotation: Tensor, translation: Tensor) -> Tensor:
    top = torch.cat((rotation, translation[..., None]), dim=-1)
    last = torch.eye(4, dtype=top.dtype, device=top.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, last), dim=-2)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """The product a @ b in the operands' precision, whatever autocast would have."""
    with torch.autocast(a.device.type, enabled=False):
        return a @ b


def _precise(tensor: Tensor) -> torch.dtype:
    return torch.promote_types(tensor.dtype, torch.float32)


def _identity(like: Tensor) -> Tensor:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device).expand_as(like)
