"""Settings of training."""

from __future__ import annotations

from itertools import pairwise

import pytest

from gvtools.errors import OptionError
from gvtools.training.options import OptimizerOptions


def test_the_rate_rises_and_falls_once_a_cycle():
    once = OptimizerOptions(steps=100, rate=1.0, warmup=0.1, final=0.05)
    rates = [once.rate_at(step) for step in range(100)]
    assert rates[:10] == pytest.approx([0.1 * (i + 1) for i in range(10)])
    assert all(a >= b for a, b in pairwise(rates[9:]))
    assert rates[-1] == pytest.approx(0.05, abs=1e-3) and min(rates) >= 0.05
    twice = OptimizerOptions(steps=200, rate=1.0, warmup=0.1, final=0.05, cycles=2)
    assert [twice.rate_at(step) for step in range(200)] == rates * 2
    steady = OptimizerOptions(steps=100, rate=1.0, warmup=0.1, schedule="constant")
    assert steady.rate_at(0) == pytest.approx(0.1) and steady.rate_at(99) == 1.0


def test_more_cycles_than_steps_are_refused():
    with pytest.raises(OptionError, match=r"optimizer\.cycles"):
        OptimizerOptions(steps=3, cycles=4)
