"""Which inverse depths are tried, and how to read the best one out of a cost volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gvtools.cameras import Cameras
from gvtools.depth.stereo.depth_range import DepthRange
from gvtools.depth.stereo.warps import disparity_rate

FEWEST, MOST = 8, 256


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Planes parallel to the reference's image, evenly spaced in inverse depth.

    Attributes:
        inverse_depths: (D,) float32, ascending, 1 / scene units.
        step: their spacing.
    """

    inverse_depths: torch.Tensor
    step: float


def plane_hypotheses(
    reference: Cameras, sources: Cameras, depths: DepthRange, *, planes: int | None
) -> Hypotheses:
    """As many planes as the baseline resolves on this level.

    Args:
        reference: the level's camera, a batch of one.
        sources: the level's source cameras.
        depths: what is searched.
        planes: how many; None for one per pixel of disparity in the source that moves most,
            between 8 and 256.
    """
    low, high = 1 / depths.far, 1 / depths.near
    if planes is None:
        rate = disparity_rate(reference, sources, depths.near, far=depths.far)
        planes = int(np.clip(np.ceil(rate.max() * (high - low)) + 1, FEWEST, MOST))
    inverse = np.linspace(low, high, planes, dtype=np.float32)
    return Hypotheses(torch.from_numpy(inverse), (high - low) / (planes - 1))


def best_plane(volume: torch.Tensor, hypotheses: Hypotheses) -> tuple[torch.Tensor, torch.Tensor]:
    """The cheapest plane of each pixel, refined between the planes by a parabola.

    Args:
        volume: (H, W, D) float32 costs.
        hypotheses: the D planes.

    Returns:
        (H, W) float32 inverse depth, and (H, W) int64 which plane was cheapest.
    """
    count = volume.shape[-1]
    index = volume.argmin(dim=-1)
    inner = index.clamp(1, count - 2)
    left, middle, right = (
        volume.gather(-1, (inner + shift)[..., None])[..., 0] for shift in (-1, 0, 1)
    )
    shift = parabola(left, middle, right)
    shift = torch.where(index == inner, shift, torch.zeros_like(shift))
    first = float(hypotheses.inverse_depths[0])
    return first + (index + shift) * hypotheses.step, index


def parabola(left: torch.Tensor, middle: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Where the parabola through costs at -1, 0 and 1 is lowest, within half a step; 0 if flat."""
    bend = left + right - 2 * middle
    lowest = (middle <= left) & (middle <= right) & (bend > 1e-6)
    shift = (left - right) / (2 * bend.clamp(min=1e-6))
    return torch.where(lowest, shift.clamp(-0.5, 0.5), torch.zeros_like(shift))
