"""Picture sizes that a network with patches takes, and maps from one size to another."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

# Neighbours whose depths differ by more than this factor lie on two surfaces.
EDGE = 1.1


def model_size(height: int, width: int, *, longest: int, patch: int) -> tuple[int, int]:
    """(H, W) of a network's pictures: the aspect kept as well as multiples of the patch allow."""
    factor = longest / max(height, width)
    rows, columns = (max(1, round(side * factor / patch)) * patch for side in (height, width))
    return rows, columns


def resampled(x: Tensor, size: tuple[int, int]) -> Tensor:
    """(B, C, h, w) to (B, C, H, W): bilinear, with an antialias filter where it shrinks."""
    if tuple(x.shape[-2:]) == size:
        return x
    return F.interpolate(x, size=size, mode="bilinear", align_corners=False, antialias=True)


def resampled_depth(depth: Tensor, size: tuple[int, int]) -> Tensor:
    """(T, h, w) depth > 0 to (T, H, W), with none that lies between two surfaces.

    Within a surface the inverse of the depth is interpolated, which keeps a plane a plane; at an
    edge, and where the picture shrinks, a pixel takes the depth of the one that it lies in.
    """
    before = depth.shape[-2], depth.shape[-1]
    if before == size:
        return depth
    nearest = F.interpolate(depth[:, None], size=size, mode="nearest-exact")
    if size[0] < before[0] or size[1] < before[1]:
        return nearest[:, 0]
    farthest = F.max_pool2d(depth[:, None], 3, stride=1, padding=1)
    closest = -F.max_pool2d(-depth[:, None], 3, stride=1, padding=1)
    edge = F.interpolate((farthest > EDGE * closest).float(), size=size, mode="nearest-exact")
    smooth = 1 / resampled(1 / depth[:, None], size)
    return torch.where(edge > 0, nearest, smooth)[:, 0]
