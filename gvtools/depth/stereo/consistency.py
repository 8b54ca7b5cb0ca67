"""What other views' own depth says about a view's depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gvtools.cameras import Cameras
from gvtools.depth.stereo.matching_torch import pixel_centers
from gvtools.depth.stereo.warps import relative_warps

# Weight of a confirming view's depth over the view's own, when they are averaged.
OTHERS = 1.0


@dataclass(frozen=True, eq=False)
class Agreement:
    """How a view's depth stands to that of other views.

    Attributes:
        views: (H, W) int64, how many others confirm each pixel.
        spread: (H, W) float32, mean relative difference to those that do; 0 without any.
        inverse_depth: (H, W) float32, mean of the view's own and the confirming views'.
    """

    views: torch.Tensor
    spread: torch.Tensor
    inverse_depth: torch.Tensor


def agreement(
    inverse_depth: torch.Tensor,
    reference: Cameras,
    others: Sequence[tuple[torch.Tensor, Cameras]],
    *,
    tolerance: float,
) -> Agreement:
    """Compare a view's depth with the depth maps of other views.

    Each pixel is carried into the other view, that view's depth is read there, and carried back
    along the pixel's own ray: it confirms when both depths differ by no more than the tolerance.

    Args:
        inverse_depth: (H, W), 0 where unknown.
        reference: the view's camera for these pixels, a batch of one.
        others: for each other view its (H', W') inverse depth, 0 where unknown, and its camera.
        tolerance: relative.
    """
    height, width = inverse_depth.shape
    v, u = pixel_centers(height, width, inverse_depth.device)
    known = inverse_depth > 0
    count = torch.zeros((height, width), dtype=torch.int64, device=inverse_depth.device)
    total = torch.zeros_like(inverse_depth)
    spread = torch.zeros_like(inverse_depth)
    for other, camera in others:
        warps = relative_warps(reference, camera)
        A, o = warps.matrix[0].astype(np.float32), warps.offset[0].astype(np.float32)
        x, y, z = (
            float(A[i, 0]) * u + float(A[i, 1]) * v + float(A[i, 2]) + inverse_depth * float(o[i])
            for i in range(3)
        )
        z = torch.where(z > 1e-6, z, torch.ones_like(z))
        column, row = (x / z).floor().long(), (y / z).floor().long()
        inside = (column >= 0) & (row >= 0) & (column < other.shape[1]) & (row < other.shape[0])
        inside &= known & (z > 1e-6)
        cell = row.clamp(0, other.shape[0] - 1) * other.shape[1] + column.clamp(
            0, other.shape[1] - 1
        )
        theirs = other.reshape(-1)[cell]
        inside &= theirs > 0
        # z is the other view's depth over the reference's; the same ratio carries it back.
        seen = torch.where(inside, theirs * z, torch.ones_like(theirs))
        difference = inverse_depth / seen - 1
        near = inside & (difference.abs() <= tolerance)
        count += near
        total += torch.where(near, OTHERS * seen, torch.zeros_like(seen))
        spread += torch.where(near, difference.abs(), torch.zeros_like(seen))
    mean = (inverse_depth + total) / (1 + OTHERS * count)
    return Agreement(
        count, spread / count.clamp(min=1), torch.where(known, mean, torch.zeros_like(mean))
    )
