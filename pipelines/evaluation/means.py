"""Means over views as JSON has them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from gvtools.evaluation.intervals import mean_interval


def interval(values: Iterable[float | None], seed: int) -> dict[str, Any]:
    """Mean, ends of its bootstrap interval, and how many values there are.

    Args:
        values: one for each view; None and NaN are left out.
        seed: of the resampling.
    """
    return asdict(mean_interval(values, seed=seed))


def mean(values: Iterable[float | None]) -> float | None:
    """The mean of the values that are there."""
    return mean_interval(values).mean
