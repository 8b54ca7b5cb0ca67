from __future__ import annotations

import importlib.util
import json

import geoverse_models as micro
import pytest
import torch
from command_line import run_command

from gvtools.completers.geoverse import model as stages
from gvtools.completers.geoverse.config import named
from gvtools.completers.geoverse.flow import interval_bounds
from gvtools.completers.geoverse.model import LEVEL0, LEVEL1
from gvtools.errors import OptionError
from gvtools.networks.compute import attend
from pipelines.bench import side_by_side
from pipelines.bench.complete import StageClock, TimedPass, module_bytes, parameters, total
from pipelines.bench.options import CompleteOptions
from pipelines.bench.random_model import random_features, random_model, random_video, random_views

pytestmark = pytest.mark.usefixtures("one_thread")

TERA = 1e12
STAGES = [
    "hint encoding",
    "level-1 step 1",
    "level-1 step 2",
    "cascade step 1",
    "decoding",
    "decoding: encoder blocks",
    "decoding: geometry head",
    "decoding: RGB head",
    "between stages",
    "pass",
]


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch):
    monkeypatch.setattr(side_by_side, "SETTLE_SECONDS", 0.0)


def run(*words: object) -> None:
    run_command("bench", "complete", *words)


# Counting.


def timed(config, *, context: int = 1, targets: int = 2, steps: int = 1) -> TimedPass:
    batch = random_views((32, 32), context=context, targets=targets)
    return TimedPass(
        micro.model(config),
        batch,
        bounds=interval_bounds(steps),
        cascade_bounds=interval_bounds(1),
        video=random_features(config, batch),
    )


def test_attention_costs_four_flops_a_pair_and_channel(monkeypatch):
    """Linear layers too: two a weight and row. Torch leaves attention on a CPU out by default."""
    q, k = torch.randn(2, 3, 11, 8), torch.randn(2, 3, 17, 8)
    layer = torch.nn.Linear(30, 50)

    one = timed(micro.config())

    def generate(*_, **options):
        with one.model.clock(stages.HINTS):
            attend(q, k, k)
        with one.model.clock(stages.DECODE):
            layer(torch.randn(2, 7, 30))

    monkeypatch.setattr(one.model, "generate", generate)
    assert one.flops() == {stages.HINTS: 4 * 2 * 3 * 11 * 17 * 8, stages.DECODE: 2 * 14 * 30 * 50}


def test_the_control_branch_is_part_of_a_step():
    plain = timed(micro.config()).flops()
    controlled = timed(micro.config(injection="control"), steps=2).flops()
    assert controlled["level-1 step 2"] == controlled["level-1 step 1"] > plain["level-1 step 1"]


@pytest.mark.skipif(importlib.util.find_spec("diffusers") is None, reason="needs diffusers")
def test_a_random_video_prior_has_the_published_size():
    config = named("base")
    assert config.video is not None
    prior = random_video(config.video, "meta")
    parts = sum(p.numel() for p in prior.networks.transformer.parameters())
    assert parts == pytest.approx(7.394e9, rel=0.001)


# The clock.


def test_growth_is_noted_by_stage_and_step():
    now = iter([0, 1, 10, 13, 20, 27, 30, 31, 40, 45, 100, 101, 103, 110]).__next__
    clock = StageClock(now)
    with clock("hint encoding"):
        pass
    for _ in range(4):
        with clock(LEVEL1):
            pass
    # Two evaluations a step, as guidance has it; a part of the decoding within it.
    with clock("decoding"), clock("RGB head"):
        pass
    rows = clock.rows({LEVEL1: 2, LEVEL0: 1})
    assert rows == {
        "hint encoding": 1,
        "level-1 step 1": 3 + 7,
        "level-1 step 2": 1 + 5,
        "decoding": 110 - 100,
        "decoding: RGB head": 103 - 101,
    }
    assert total(rows) == 1 + 10 + 6 + 10


# The whole benchmark.


@pytest.fixture
def weights(tmp_path):
    return micro.weights_folder(tmp_path / "weights")


def figures(tmp_path, *words: object) -> dict:
    file = tmp_path / "complete.json"
    run(*words, "--json", file)
    return json.loads(file.read_text())


def test_json_of_a_run(tmp_path, weights):
    data = figures(
        tmp_path, "--weights", weights, "--targets", 2, "--steps", 2, "--repeat", 2,
        "--device", "cpu", "--size", "24x32",
    )  # fmt: skip
    rows = data["results"]
    assert [row["name"] for row in rows] == STAGES
    for row in rows:
        assert row["ours_s"] >= row["ours_min_s"] > 0 or row["name"] == "between stages"
    outer = [row for row in rows if row["within"] is None and row["name"] != "pass"]
    assert sum(row["share"] for row in outer) == pytest.approx(1)
    by_name = {row["name"]: row for row in rows}
    decoding = [row for row in rows if row["within"] == "decoding"]
    assert sum(row["flops"] for row in decoding) == by_name["decoding"]["flops"]
    whole = by_name["pass"]
    assert whole["tflop_per_s"] == pytest.approx(whole["flops"] / whole["ours_s"] / TERA)
    assert data["config"] == "micro" and data["weights"] == str(weights)
    assert data["size"] == [24, 32] and data["precision"] == "float32" and data["video"] is False
    assert data["weights_bytes"] == module_bytes(micro.model())
    assert data["first_pass_s"] > 0


def test_the_table_is_printed(capsys):
    run(
        "--size", 24, "--context", 1, "--targets", 1, "--steps", 1, "--repeat", 1,
        "--device", "cpu", "--precision", "bfloat16",
    )  # fmt: skip
    out = capsys.readouterr().out
    for said in (
        "tiny, random weights, 1 + 1 views of 24x24, 1 + 1 steps, cpu, bfloat16",
        "first pass",
    ):
        assert said in out
    for name in ("hint encoding", "decoding: RGB head", "level-1 denoiser", "peak", "TFLOP/s"):
        assert name in out


def test_a_video_prior_that_is_not_run_has_a_stand_in(tmp_path):
    folder = micro.weights_folder(tmp_path / "w", micro.config(injection="control"))
    data = figures(
        tmp_path, "--weights", folder, "--targets", 1, "--steps", 1, "--repeat", 1,
        "--device", "cpu", "--size", 32, "--no-video",
    )  # fmt: skip
    assert data["video_stand_in"] and data["video"] is False
    names = [row["name"] for row in data["results"]]
    assert "video features" in names
    assert data["parameters"]["control branch"] > 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--size", "50"), "multiples of 12"),
        (("--size", "5y5"), "expected HxW or N"),
        (("--steps", 0), "steps"),
        (("--repeat", 0), "repeat"),
        (("--points", 5000), "--points is of fuse and splat"),
        (("--video",), "tiny has no video prior"),
        (("--config", "tiny", "--weights", "x"), "both --config and --weights"),
    ],
)
def test_options_that_do_not_fit(words, said):
    with pytest.raises(OptionError, match=said):
        run(*words)


def test_other_benchmarks_know_no_model():
    with pytest.raises(OptionError, match="--compile, --steps given"):
        run_command("bench", "fuse", "--steps", 3, "--compile")


def test_sizes():
    assert CompleteOptions(size="504").size == (504, 504)
    assert CompleteOptions(size="336x504").size == (336, 504)


# Random models and views.


def test_nothing_of_a_random_model_is_zero_and_its_numbers_are_finite():
    model = random_model(micro.CONFIG)
    assert all(bool(parameter.any()) for parameter in model.parameters())
    again = random_model(micro.CONFIG)
    for one, other in zip(model.parameters(), again.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    made = model.generate(random_views((32, 32), context=1, targets=1))
    assert made.decoded.rgb.isfinite().all() and made.decoded.geometry.depth.isfinite().all()
    assert parameters(model)["total"] == sum(p.numel() for p in model.parameters())


def test_random_views_look_at_one_point():
    batch = random_views((24, 36), context=2, targets=3)
    point = torch.tensor([0.0, 0.0, 2.0, 1.0])
    seen = (batch.K[0] @ (batch.cam_from_world[0] @ point)[:, :3, None])[..., 0]
    torch.testing.assert_close(seen[:, 0] / seen[:, 2], torch.full((5,), 18.0))
    torch.testing.assert_close(seen[:, 1] / seen[:, 2], torch.full((5,), 12.0))
    rotation = batch.cam_from_world[0, :, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(5, 3, 3))
    assert batch.valid[:, :2].all() and 0.3 < batch.valid[:, 2:].float().mean() < 0.95
