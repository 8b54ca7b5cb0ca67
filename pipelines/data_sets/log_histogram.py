"""Percentiles of any number of positive values in bounded memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Bins from 10^LOW to 10^HIGH; neighbouring bins' middles differ by 1.16 %.
LOW, HIGH, PER_DECADE = -6, 8, 200


class LogHistogram:
    """Counts of values by their logarithm.

    A percentile is the middle of its bin: right to 0.6 % from 1e-6 to 1e8. The smallest and the
    largest value are kept as they are; a percentile below 1e-6 is given as the smallest.

    >>> values = LogHistogram()
    >>> values.add([1, 2, 3, 4, 1000])
    >>> round(values.percentile(50), 1), values.maximum
    (3.0, 1000.0)
    """

    def __init__(self) -> None:
        self.count = 0
        self.minimum = np.inf
        self.maximum = -np.inf
        self._bins = np.zeros((HIGH - LOW) * PER_DECADE, np.int64)

    def add(self, values: ArrayLike) -> None:
        """Count values of any shape that are 0 or more."""
        flat = np.asarray(values, np.float64).ravel()
        if not flat.size:
            return
        self.count += flat.size
        self.minimum = min(self.minimum, float(flat.min()))
        self.maximum = max(self.maximum, float(flat.max()))
        logs = np.log10(np.maximum(flat, 10.0**LOW))
        rows = np.clip(((logs - LOW) * PER_DECADE).astype(np.int64), 0, len(self._bins) - 1)
        self._bins += np.bincount(rows, minlength=len(self._bins))

    def percentile(self, percent: float) -> float:
        """The value below which so many of a hundred lie; NaN where there is none."""
        if not self.count:
            return float("nan")
        # The nearest rank, as numpy's method "inverted_cdf" takes it.
        rank = max(1, int(np.ceil(percent / 100 * self.count)))
        row = int(np.searchsorted(np.cumsum(self._bins), rank))
        if row == 0:
            return self.minimum
        middle = 10.0 ** (LOW + (row + 0.5) / PER_DECADE)
        return float(np.clip(middle, self.minimum, self.maximum))
