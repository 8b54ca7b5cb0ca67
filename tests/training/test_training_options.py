"""Settings of training."""

from __future__ import annotations

import re
from itertools import pairwise

import pytest

from gvtools.errors import OptionError
from gvtools.settings import with_texts
from gvtools.training.options import (
    HeadsStageOptions,
    OptimizerOptions,
    shipped_or_read,
)
from gvtools.training.samples import TrainingSamples


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


def test_heads_of_which_none_learns_are_refused():
    with pytest.raises(OptionError, match="ray, rgb and depth are all 0"):
        HeadsStageOptions(ray=0, rgb=0, depth=0)
    with pytest.raises(OptionError, match=r"heads\.hf"):
        HeadsStageOptions(hf=-1)


def test_a_setting_reaches_a_stage_that_the_training_does_not_have():
    base, _ = shipped_or_read("base")
    assert base.heads is None
    changed = with_texts(base, ["heads.optimizer.steps=3", "heads.origin=1.5"])
    assert changed.heads is not None
    assert changed.heads.optimizer.steps == 3 and changed.heads.origin == 1.5


def test_the_faults_of_observations_are_settings():
    text = ["data.faults.projection=0.1", "data.faults.clean=0", "data.faults.absent=0"]
    config, folder = shipped_or_read("tiny")
    noisy, plain = (
        TrainingSamples(changed, config.network(folder))._data_set("train").describe()
        for changed in (with_texts(config, text), config)
    )
    assert noisy["faults"]["projection"] == 0.1 and plain["faults"]["projection"] == 0
    assert {k: v for k, v in noisy.items() if k != "faults"} == {
        k: v for k, v in plain.items() if k != "faults"
    }


@pytest.mark.parametrize("text", ["seed.deep=3", "heads.origin.deep=3", "model.name=tiny"])
def test_a_setting_of_what_has_none_is_refused(text):
    with pytest.raises(OptionError, match="settings of its own"):
        with_texts(shipped_or_read("tiny")[0], [text])


@pytest.mark.parametrize(
    "text",
    [
        "encoder.depth=-5",
        "encoder.noise=-1",
        "encoder.hints=1.5",
        "encoder.statistics=0",
        "denoiser.decode=-1",
        "denoiser.cameras=7",
        "denoiser.source_noise=-3",
        "reflow.guidance=-1",
        "heads.drop_level0=2",
        "heads.temperature=-1",
        "data.size=[0,0]",
    ],
)
def test_values_outside_their_range_are_refused_before_anything_is_trained(text):
    with pytest.raises(OptionError, match=text.partition("=")[0].replace(".", r"\.")):
        with_texts(shipped_or_read("tiny")[0], [text])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("encoder.optimizer.betas=[2,3]", "optimizer.betas 2.0"),
        ("reflow.bounds=[1,0.9,0.5]", "end at 0.5; expected 1 = tau_0 > tau_1 > ... > tau_K = 0"),
    ],
)
def test_what_would_leave_noise_or_never_learn_is_refused(text, said):
    with pytest.raises(OptionError, match=re.escape(said)):
        with_texts(shipped_or_read("tiny")[0], [text])
