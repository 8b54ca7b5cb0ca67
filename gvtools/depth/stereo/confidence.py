"""How likely a depth is right, and how to tell whether such a claim is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ShapeError

Float64 = NDArray[np.float64]

# A depth counts as right when its relative error is below this.
RIGHT = 0.05
# Logistic regression of "right" on the features below, fitted to kept pixels of the sample room
# (exact depth) and of 7-Scenes kitchen (sensor depth), both counting alike.
WEIGHTS = (-1.077, 0.477, 0.107, -0.711)
BIAS = 2.12
LEAST, MOST = 0.02, 0.99


@dataclass(frozen=True, eq=False)
class Reliability:
    """A reliability diagram.

    Attributes:
        predicted: (B,) float64 mean confidence of each bin; NaN where it is empty.
        observed: (B,) float64 share of each bin that was right.
        count: (B,) int64.
        error: expected calibration error: mean of their difference over all depths.
    """

    predicted: Float64
    observed: Float64
    count: NDArray[np.int64]
    error: float


def features(cost: torch.Tensor, views: torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """(4, H, W) what the confidence is computed from.

    Args:
        cost: (H, W) photometric cost in [0, 1].
        views: (H, W) how many other views confirm.
        spread: (H, W) mean relative difference to these.
    """
    number = views.to(cost.dtype)
    return torch.stack([cost, number.clamp(max=4), (number >= 2).to(cost.dtype), 100 * spread])


def confidence_of(cost: torch.Tensor, views: torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """(H, W) float32 predicted probability that the depth's relative error is below RIGHT."""
    weights = torch.tensor(WEIGHTS, device=cost.device)
    logit = (features(cost, views, spread) * weights[:, None, None]).sum(0) + BIAS
    return torch.sigmoid(logit).clamp(LEAST, MOST)


def reliability(confidence: ArrayLike, right: ArrayLike, *, bins: int = 10) -> Reliability:
    """How often depths of each confidence were right.

    Args:
        confidence: (N,) in [0, 1].
        right: (N,) bool.
        bins: of equal width.

    Raises:
        ShapeError: other lengths, or nothing.
    """
    claimed = np.asarray(confidence, np.float64).ravel()
    truth = np.asarray(right, bool).ravel()
    if claimed.shape != truth.shape or not len(claimed):
        raise ShapeError(
            f"reliability: {claimed.size} confidences and {truth.size} outcomes; expected as many "
            "of both, at least one"
        )
    which = np.clip((claimed * bins).astype(int), 0, bins - 1)
    count = np.bincount(which, minlength=bins)
    with np.errstate(invalid="ignore"):
        predicted = np.bincount(which, claimed, bins) / count
        observed = np.bincount(which, truth, bins) / count
    error = float(np.nansum(count * np.abs(predicted - observed)) / count.sum())
    return Reliability(predicted, observed, count, error)
