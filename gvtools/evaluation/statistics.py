"""Means with bootstrap intervals, statistics of errors, shares and medians; None stands for none.

The percentile bootstrap of B. Efron, "Bootstrap methods: another look at the jackknife", Annals of
Statistics 7(1), 1979, by scipy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def mean_known(values: Iterable[float | None]) -> float | None:
    """The mean of the values that are neither None nor NaN; None without any, or of ±∞."""
    known = np.array([value for value in values if value is not None and value == value])
    if not len(known) or {np.inf, -np.inf} <= set(known.tolist()):
        return None
    return float(known.mean())


def mean_interval(values: Iterable[float | None], *, seed: int = 0) -> Interval:
    """The mean of the values that are neither None nor NaN, with its bootstrap interval.

    The same values and seed give the same interval.
    """
    known = np.array([value for value in values if value is not None and value == value])
    mean, count = mean_known(known), len(known)
    if mean is None or count < 2 or not np.isfinite(known).all():
        return Interval(mean, None, None, count)
    if np.ptp(known) == 0:
        return Interval(mean, mean, mean, count)
    from scipy.stats import bootstrap

    ends = bootstrap(
        (known,),
        np.mean,
        confidence_level=LEVEL,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(mean, float(ends.low), float(ends.high), count)


@dataclass(frozen=True)
class ErrorStatistics:
    """What a set of errors sums up to; the unit is that of the errors."""

    rmse: float
    mean: float
    median: float
    std: float  # of the population
    min: float
    max: float
    n: int  # how many errors

    @staticmethod
    def of(errors: ArrayLike) -> ErrorStatistics | None:
        """Of (N,) errors; None when there are none."""
        values = np.asarray(errors, np.float64)
        if not values.size:
            return None
        return ErrorStatistics(
            rmse=float(np.sqrt(np.mean(values**2))),
            mean=float(values.mean()),
            median=float(np.median(values)),
            std=float(values.std()),
            min=float(values.min()),
            max=float(values.max()),
            n=values.size,
        )


def mean_of(values: NDArray[np.float64]) -> float | None:
    """The mean; None of no values."""
    return float(values.mean()) if values.size else None


def median_of(values: NDArray[np.float64]) -> float | None:
    """The median; None of no values."""
    return float(np.median(values)) if values.size else None


def share(part: float, whole: float) -> float | None:
    """The part of a whole; None where the whole is 0."""
    return part / whole if whole > 0 else None
