"""Whether a view and its sources were taken from places far enough apart to tell any depth."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.depth.stereo.depth_range import DepthRange
from gvtools.depth.stereo.matching import Level, Matcher
from gvtools.depth.stereo.warps import disparity_rate

# Pixels by which the nearest depth must move in a source against infinity.
LEAST_DISPARITY = 0.5
# Below which a pixel is matched at all; by how much depth must match better than a turn alone; and
# the share of the matched pixels that have to.
MATCHED, BETTER, BETTER_SHARE = 0.3, 0.02, 0.05


def enough_disparity(reference: Cameras, sources: Cameras, depths: DepthRange) -> NDArray[np.bool_]:
    """(S,) whether each source sees the nearest depth move at all.

    Args:
        reference: the finest level's camera, a batch of one.
        sources: S cameras.
        depths: of the reference.
    """
    rate = disparity_rate(reference, sources, depths.near, far=np.inf)
    return rate / depths.near >= LEAST_DISPARITY


def only_turned(
    level: Level, cost: torch.Tensor, textured: torch.Tensor, *, matcher: Matcher
) -> bool:
    """Whether a turn of the camera explains the pictures as well as any depth does.

    Infinite depth moves pixels by the turn alone. Where cameras moved next to nothing, it matches
    every pixel at least as well as the depth that was found.

    Args:
        level: the pictures.
        cost: (H, W) float32 photometric cost of the depth that was found.
        textured: (H, W) bool.
        matcher: back end.
    """
    turned = matcher.sweep(level, torch.zeros(1, device=cost.device))[..., 0]
    matched = textured & (torch.minimum(cost, turned) < MATCHED)
    if not matched.any():
        return False
    return float((turned - cost > BETTER)[matched].float().mean()) < BETTER_SHARE
