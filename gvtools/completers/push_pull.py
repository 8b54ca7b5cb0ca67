"""Filled projections, and push-pull filling in torch: averages of known pixels, coarse to fine.

Of use where a network should see a plausible picture instead of black holes. (Gortler et al. 1996,
The Lumigraph.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Filled:
    """Projections with their holes filled, however that was done."""

    rgb: NDArray[np.float32]  # (T, H, W, 3) in [0, 1]
    depth: NDArray[np.float32]  # (T, H, W) z-depth, scene units; 0 = none
    # (T, H, W) of the depth, in [0, 1]; None where the fill has no notion of it.
    confidence: NDArray[np.float32] | None = None
    # (T, H, W) weight of the photographs that a hole's colour was seen in, in [0, 1]; None where
    # none was looked at.
    looked_up: NDArray[np.float32] | None = None

    def select(self, index: Sequence[int]) -> Filled:
        """Some views, in that order."""
        rows = list(index)
        images = {name: values for name, values in vars(self).items() if values is not None}
        return Filled(**{name: values[rows] for name, values in images.items()})


def push_pull(values: Tensor, valid: Tensor) -> Tensor:
    """Holes filled from averages over growing windows; known pixels stay as they are.

    ``values`` (B, C, H, W) may hold anything in the holes, NaN too; ``valid`` (B, 1, H, W) is > 0
    where known. Zeros for an image without a known pixel.
    """
    weight = (valid > 0).to(values.dtype)
    known = torch.where(weight > 0, values, values.new_zeros(()))
    pyramid = [(known, weight)]
    while max(known.shape[-2:]) > 1:
        total, weight = _halve(known * weight), _halve(weight)
        known = total / weight.clamp_min(torch.finfo(values.dtype).tiny)
        # An average counts by its share of known pixels, wholly from a quarter on.
        weight = (4 * weight).clamp_max(1)
        pyramid.append((known, weight))
    filled, _ = pyramid.pop()
    while pyramid:
        known, weight = pyramid.pop()
        size = (known.shape[-2], known.shape[-1])
        coarse = F.interpolate(filled, size=size, mode="bilinear", align_corners=False)
        filled = torch.lerp(coarse, known, weight)
    return filled


def push_pull_depth(depth: Tensor, valid: Tensor) -> Tensor:
    """Depth (B, 1, H, W) filled in its logarithm; see ``push_pull``."""
    known = (valid > 0) & (depth > 0)
    log = torch.where(known, depth, torch.ones_like(depth)).log()
    filled = push_pull(log, known).exp()
    return torch.where(known.flatten(1).any(1)[:, None, None, None], filled, 0.0)


def _halve(x: Tensor) -> Tensor:
    """Means of 2x2 windows; the odd last row and column stand for themselves and count in full."""
    return F.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False)
