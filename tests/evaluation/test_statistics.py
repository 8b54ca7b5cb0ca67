from __future__ import annotations

import numpy as np
import pytest

from gvtools.evaluation.statistics import mean_interval


def test_the_interval_holds_the_mean_of_the_population_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    held = 0
    for trial in range(200):
        found = mean_interval(rng.normal(3, 1, 30), seed=trial)
        held += found.low <= 3 <= found.high
    assert 175 <= held <= 200


def test_more_values_narrow_it_and_the_seed_decides_it():
    values = np.random.default_rng(1).normal(size=400)
    few, many = mean_interval(values[:10]), mean_interval(values)
    assert few.high and few.low and many.high and many.low
    assert few.high - few.low > many.high - many.low
    assert mean_interval(values, seed=3) == mean_interval(values, seed=3)
    assert mean_interval(values, seed=3) != mean_interval(values, seed=4)


def test_what_is_not_there_is_left_out_and_counted():
    found = mean_interval([1.0, None, 3.0, float("nan")])
    assert (found.mean, found.n) == (2.0, 2)
    assert mean_interval([]) == mean_interval([None])
    assert mean_interval([]).mean is None
    one = mean_interval([5.0])
    assert (one.mean, one.low, one.n) == (5.0, None, 1)
    same = mean_interval([2.0, 2.0])
    assert same.low == same.high == pytest.approx(2)
