"""What enters the video model: views at its resolution, where they are valid, and their seeds."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.completers.geoverse.noise import view_seed


def resized(images: Tensor, valid: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Views and their validity in another size; colours of invalid pixels do not bleed in.

    Args:
        images: (B, V, 3, H, W).
        valid: (B, V, 1, H, W), bool or 1 = valid.
        size: rows and columns in px.

    Returns:
        Images (B, V, 3, *size) float32, 0 where not valid, and validity (B, V, 1, *size) float32,
        of the nearest pixel, 0 or 1.
    """
    usable = (valid if valid.dtype == torch.bool else valid > 0.5).flatten(0, 1)
    weight = usable.float()
    seen = torch.where(usable, images.flatten(0, 1).float(), 0.0)
    if tuple(images.shape[-2:]) != size:
        seen, share = (
            F.interpolate(x, size=size, mode="bilinear", antialias=True) for x in (seen, weight)
        )
        weight = F.interpolate(weight, size=size, mode="nearest-exact")
        # The nearest pixel has the largest share, so the divisor is far from 0 where it counts.
        seen = torch.where(weight > 0, seen / share.clamp_min(1e-6), 0.0)
    count = images.shape[:2]
    return seen.unflatten(0, count), weight.unflatten(0, count)


def seed_rows(seed: int | Sequence[Sequence[int]], batch: int, views: int) -> list[list[int]]:
    """A seed for each view, B rows of V.

    Args:
        seed: one number for all, or the rows themselves.
        batch: B.
        views: V.
    """
    if isinstance(seed, int):
        return [[view_seed(seed, item, view) for view in range(views)] for item in range(batch)]
    return [list(row) for row in seed]
