"""Whether a claimed confidence comes true: a reliability diagram and its calibration error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ShapeError

Float64 = NDArray[np.float64]


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
