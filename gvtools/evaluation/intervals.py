"""Means with the interval that resampling gives them: how far another choice of views may move it.

The percentile bootstrap of B. Efron, "Bootstrap methods: another look at the jackknife", Annals of
Statistics 7(1), 1979, by scipy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

LEVEL = 0.95
RESAMPLES = 2000


@dataclass(frozen=True)
class Interval:
    """A mean and where 95 % of resampled means lie."""

    # Of the values; None without any, infinite when one is, None for both infinities.
    mean: float | None
    low: float | None  # lower end; None for fewer than two values, or infinite ones
    high: float | None  # upper end, likewise
    n: int  # how many values; those that are None are left out


def mean_interval(values: Iterable[float | None], *, seed: int = 0) -> Interval:
    """The mean of the values that are neither None nor NaN, with its bootstrap interval.

    The same values and seed give the same interval.
    """
    kept = np.array([value for value in values if value is not None and value == value])
    if not len(kept):
        return Interval(None, None, None, 0)
    if {np.inf, -np.inf} <= set(kept.tolist()):
        return Interval(None, None, None, len(kept))
    mean = float(kept.mean())
    if len(kept) < 2 or not np.isfinite(kept).all():
        return Interval(mean, None, None, len(kept))
    if np.ptp(kept) == 0:
        return Interval(mean, mean, mean, len(kept))
    from scipy.stats import bootstrap

    found = bootstrap(
        (kept,),
        np.mean,
        confidence_level=LEVEL,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(mean, float(found.low), float(found.high), len(kept))
