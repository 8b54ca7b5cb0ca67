from __future__ import annotations

import json
import re
from itertools import pairwise

import pytest

from gvtools.errors import OptionError
from gvtools.settings import with_texts
from gvtools.training.data import TrainingSamples
from gvtools.training.options import EncoderStageOptions, OptimizerOptions, shipped_or_read
from gvtools.training.records import TrainingLog, read_log


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


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("encoder.optimizer.cycles=9999", "cycles 9999; expected at most optimizer.steps"),
        ("data.pool=12", "data.pool '12'; expected a multiple of 8"),
        ("data.cache=here data.pool=0", "data.cache needs data.pool"),
        ("heads.ray=0 heads.rgb=0 heads.depth=0", "ray, rgb and depth are all 0"),
        ("heads.origin.deep=3", "heads.origin is a value without settings below it"),
        ("encoder.depth=-5", "encoder.depth -5; expected at least 0"),
        ("encoder.optimizer.betas=[2,3]", "encoder.optimizer.betas 2; expected less than 1"),
        ("encoder.optimizer.betas=0.9", "betas 0.9; expected a valid tuple"),
        ("encoder.optimizer.betas=x", "betas 'x'; expected a JSON list"),
        ("encoder.optimizer.schedule=linear", "expected 'cosine' or 'constant'"),
        ("denoiser.weights.rgb=-1", "rgb -1"),
        ("denoiser.weights.rgbs=1", "did you mean 'denoiser.weights.rgb'"),
        ("data.size=[0,0]", "data.size 0; expected greater than or equal to 1"),
        (
            "reflow.bounds=[1,0.9,0.5]",
            "[1.0, 0.9, 0.5]; expected 1 = tau_0 > tau_1 > ...",
        ),
    ],
)
def test_a_wrong_text_is_one_line_before_anything_is_trained(text, complaint):
    with pytest.raises(OptionError, match=re.escape(complaint)):
        with_texts(shipped_or_read("tiny")[0], text.split())


def test_a_stage_is_left_out_and_taken_back(tmp_path):
    without = with_texts(shipped_or_read("tiny")[0], ["encoder=none"])
    path = tmp_path / "training.json"
    path.write_text(json.dumps(without.to_dict()))
    assert without.encoder is None and shipped_or_read(str(path)) == (without, tmp_path)
    path.write_text(json.dumps({**without.to_dict(), "encoder": {}}))
    assert shipped_or_read(str(path))[0].encoder == EncoderStageOptions()


def test_a_resumed_training_takes_back_the_steps_that_it_repeats(tmp_path):
    log = TrainingLog(tmp_path)
    for step in (20, 40, 60):
        log.write(step, {"loss": float(step)})
    # The last state was saved after step 40; step 60 is made again, and comes out otherwise.
    again = TrainingLog(tmp_path, step=40)
    again.write(60, {"loss": -60.0})
    (tmp_path / "log.jsonl").open("a").write('{"step": 80, "lo')  # killed while writing
    records = [(record["step"], record["loss"]) for record in read_log(tmp_path)]
    assert records == [(20, 20.0), (40, 40.0), (60, -60.0)]
