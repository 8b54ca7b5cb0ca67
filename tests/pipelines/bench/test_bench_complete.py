from __future__ import annotations

import argparse
import importlib.util
import json
from dataclasses import replace

import geoverse_models as micro
import pytest
import torch
from torch import nn

from gvtools.completers.geoverse import denoiser_blocks, shared_attention
from gvtools.completers.geoverse.config import named
from gvtools.completers.geoverse.denoiser_blocks import CameraAttention
from gvtools.completers.geoverse.flow import interval_bounds
from gvtools.completers.geoverse.projective import Projective
from gvtools.completers.geoverse.stages import LEVEL0, LEVEL1
from gvtools.errors import OptionError
from gvtools.networks.attention import attend
from gvtools.networks.depth_anything.network import DepthAnything3
from pipelines.bench import side_by_side
from pipelines.bench import timing as completion_timing
from pipelines.bench.complete import stage_rows, weight_bytes
from pipelines.bench.flops import flops, parameters, pass_flops
from pipelines.bench.options import parsed_size
from pipelines.bench.random_model import random_features, random_model, random_video, random_views
from pipelines.bench.stage_clock import StageClock, total
from pipelines.bench.timing import TimedPass, Times, compare_attention, explicit_attention
from pipelines.commands import bench
from pipelines.console import Console

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
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    bench.run(parser.parse_args(["complete", *map(str, words)]), Console())


def meta(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.empty(shape, dtype=dtype, device="meta")


def count(config, *, context: int = 2, targets: int = 6, steps: int = 1, video: bool = False):
    batch = random_views((config.image_size,) * 2, context=context, targets=targets)
    bounds = interval_bounds(steps), interval_bounds(1)
    return pass_flops(config, batch, bounds=bounds[0], cascade_bounds=bounds[1], video=video)


# Counting.


def test_a_linear_layer_costs_two_flops_a_weight_and_row():
    layer = nn.Linear(30, 50, device="meta")
    assert flops(lambda: layer(meta(2, 7, 30))) == 2 * 14 * 30 * 50


def test_attention_costs_four_flops_a_pair_and_channel():
    q, k = meta(2, 3, 11, 8), meta(2, 3, 17, 8)
    assert flops(lambda: attend(q, k, k)) == 4 * 2 * 3 * 11 * 17 * 8


def test_a_layer_of_the_denoiser_costs_its_closed_form():
    width, heads, views, grid = 48, 2, 3, (2, 4)
    tokens, head_dim = views * 8, width // heads
    with torch.device("meta"):
        layer = CameraAttention(width, heads)
        positions = Projective(
            meta(1, views, 4, 4), meta(1, views, 3, 3), (8, 8), grid=grid, head_dim=head_dim
        )
    products = 2 * tokens * width * (3 * width + width)
    scores = 4 * tokens**2 * width
    # Each of q, k, v and the output: two products of half a head with a square of that size.
    camera = 4 * 2 * 2 * tokens * heads * (head_dim // 2) ** 2
    found = flops(lambda: layer(meta(1, tokens, width), positions))
    assert found == products + scores + camera


def test_only_what_is_encoded_is_counted():
    config = micro.config()
    batch = random_views((32, 32), context=2, targets=2)
    silent = replace(batch, valid=batch.valid.clone())
    silent.valid[:, 3] = False
    one = interval_bounds(1)
    rows = [
        pass_flops(config, views, bounds=one, cascade_bounds=one).rows for views in (batch, silent)
    ]
    assert rows[1]["hint encoding"] < rows[0]["hint encoding"]
    assert rows[1]["level-1 step 1"] == rows[0]["level-1 step 1"]


def test_the_control_branch_is_part_of_a_step():
    plain, controlled = count(micro.config()), count(micro.config(injection="control"), steps=2)
    extra = controlled.rows["level-1 step 2"] - plain.rows["level-1 step 1"]
    assert extra == pytest.approx(controlled.within["control branch"] / 2)
    assert "video features" in controlled.rows and "video features" not in plain.rows
    assert controlled.parameters["control branch"] > 0


# The base model against what was counted without this code: 8 views of 504x504, 6 of them targets.


@pytest.fixture(scope="module")
def base():
    return count(replace(named("base"), video=None, injection="none"))


@pytest.mark.parametrize(
    ("row", "tflop"),
    [
        ("level-1 step 1", 28.5),
        ("cascade step 1", 18.7),
        ("decoding: RGB head", 7.9),
        ("decoding: encoder blocks", 1.3),
    ],
)
def test_base_costs_what_was_counted_independently(base, row, tflop):
    assert base.rows[row] / TERA == pytest.approx(tflop, rel=0.05)


def test_base_encodes_context_jointly_alone_and_the_first_view(base):
    # 2.1 for blocks 0 to 7 over eight views; two views and one view, encoded apart, add 0.6.
    assert 2.1 < base.rows["hint encoding"] / TERA < 1.05 * 2.1 * 11 / 8
    with torch.device("meta"):
        network = DepthAnything3(named("base").geometry)
    found = flops(lambda: network.encode(meta(1, 8, 3, 504, 504), levels=2)) / TERA
    assert found == pytest.approx(2.1, rel=0.05)


def test_the_geometry_head_leaves_out_what_nothing_reads(base):
    # The published code gives rays at four scales, 1.57 TFLOP in all, and uses the finest.
    coarser = sum((36 * scale) ** 2 for scale in (1, 2, 4))
    unread = 8 * coarser * 5 * 2 * 9 * 128 * 64 / TERA
    found = base.rows["decoding: geometry head"] / TERA
    assert found + unread == pytest.approx(1.57, rel=0.01)


def test_parameters_of_base(base):
    million = {name: value / 1e6 for name, value in base.parameters.items()}
    assert million["level-1 denoiser"] == pytest.approx(783, rel=0.01)
    assert million["cascade"] == pytest.approx(473, rel=0.01)
    assert million["RGB head"] == pytest.approx(422, rel=0.01)
    parts = [value for name, value in base.parameters.items() if name != "total"]
    assert base.parameters["total"] == sum(parts)


@pytest.mark.skipif(importlib.util.find_spec("diffusers") is None, reason="needs diffusers")
def test_the_video_prior_of_base():
    """Published figures of Wan: 174 TFLOP at 8 x 72 x 72 latents, 1.77 a view of 512 px encoded."""
    config = named("base")
    assert config.video is not None
    prior = random_video(config.video, "meta")
    images, valid = meta(1, 8, 3, 504, 504), meta(1, 8, 1, 504, 504, dtype=torch.bool)
    found = flops(lambda: prior.features(images, valid, 2)) / TERA
    # The ninth encoding is of the empty picture.
    assert found == pytest.approx(174.0 + 9 * 1.77 * (576 / 512) ** 2, rel=0.01)
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


def test_rows_without_times_are_null():
    counts = {"hint encoding": 3e12, "decoding": 2e12, "decoding: RGB head": 1e12}
    rows = {row["name"]: row for row in stage_rows(counts, Times())}
    assert rows["pass"]["flops"] == 5e12
    assert rows["decoding: RGB head"]["within"] == "decoding"
    assert all(row["ours_s"] is None and row["tflop_per_s"] is None for row in rows.values())
    timed = Times({"hint encoding": 1.0, "decoding": 3.0, "decoding: RGB head": 2.0, "pass": 4.0})
    rows = {row["name"]: row for row in stage_rows(counts, timed)}
    assert rows["decoding"]["share"] == 0.75 and rows["pass"]["share"] is None
    assert rows["hint encoding"]["tflop_per_s"] == 3.0


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
    *stages, versus = data["results"]
    assert [row["name"] for row in stages] == STAGES
    for row in stages:
        assert row["ours_s"] >= row["ours_min_s"] > 0 or row["name"] == "between stages"
        assert row["peer"] is row["peer_s"] is row["ratio"] is None and row["note"]
        assert row["repeats"] == 2
    outer = [row for row in stages if row["within"] is None and row["name"] != "pass"]
    assert sum(row["share"] for row in outer) == pytest.approx(1)
    by_name = {row["name"]: row for row in stages}
    decoding = [row for row in stages if row["within"] == "decoding"]
    assert sum(row["flops"] for row in decoding) == by_name["decoding"]["flops"]
    whole = by_name["pass"]
    assert whole["tflop_per_s"] == pytest.approx(whole["flops"] / whole["ours_s"] / TERA)
    assert versus["peer"] == "explicit attention"
    assert versus["ratio"] == pytest.approx(versus["ours_s"] / versus["peer_s"])
    assert data["config"] == "micro" and data["weights"] == str(weights)
    assert data["size"] == [24, 32] and data["precision"] == "float32" and data["video"] is False
    assert data["memory"]["weights_bytes"] == weight_bytes(micro.model())
    assert data["first_pass_s"] > 0 and data["notes"]["peer"]


def test_flops_only_runs_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(completion_timing.TimedPass, "run", None)
    data = figures(tmp_path, "--config", "tiny", "--flops-only")
    assert [row["name"] for row in data["results"] if "level-1" in row["name"]] == [
        "level-1 step 1",
        "level-1 step 2",
        "level-1 step 3",
    ]
    assert all(row["ours_s"] is None for row in data["results"])
    assert "--flops-only" in data["notes"]["ours_s"]
    assert data["parameters"]["total"] == sum(
        p.numel() for p in random_model(named("tiny"), "meta").parameters()
    )


def test_the_table_is_printed(capsys):
    run(
        "--size", 24, "--context", 1, "--targets", 1, "--steps", 1, "--repeat", 1,
        "--device", "cpu", "--precision", "bfloat16",
    )  # fmt: skip
    out = capsys.readouterr().out
    for said in ("tiny, random weights, 1 + 1 views of 24x24, 1 + 1 steps, cpu, bfloat16", "ratio"):
        assert said in out
    for name in ("hint encoding", "decoding: RGB head", "level-1 denoiser", "peak", "TFLOP/s"):
        assert name in out


def test_a_video_prior_that_is_not_run_has_a_stand_in(tmp_path):
    folder = micro.weights_folder(tmp_path / "w", micro.config(injection="control"))
    data = figures(
        tmp_path, "--weights", folder, "--targets", 1, "--steps", 1, "--repeat", 1,
        "--device", "cpu", "--size", 32, "--no-video",
    )  # fmt: skip
    assert "stand in" in data["notes"]["video features"] and data["video"] is False
    names = [row["name"] for row in data["results"]]
    assert "video features" in names
    assert data["flops_within"]["control branch"] > 0


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
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    args = parser.parse_args(["fuse", "--steps", "3", "--flops-only"])
    with pytest.raises(OptionError, match="--flops-only, --steps given"):
        bench.run(args, Console())


def test_sizes():
    assert parsed_size("504") == (504, 504)
    assert parsed_size("336x504") == (336, 504)


# Explicit attention.


def timed(config=None) -> TimedPass:
    config = config or micro.config()
    batch = random_views((32, 32), context=1, targets=2)
    return TimedPass(
        micro.model(config),
        batch,
        bounds=interval_bounds(1),
        cascade_bounds=interval_bounds(1),
        video=random_features(config, batch),
    )


@pytest.mark.parametrize("injection", ["none", "control", "shared"])
def test_explicit_attention_is_the_same_network(injection):
    compared = compare_attention(timed(micro.config(injection=injection)), repeat=1)
    assert not isinstance(compared, str)
    assert 0 <= float(compared.note.split("at most ")[1].split(" of")[0]) < 1e-5


def test_explicit_attention_is_really_used_and_put_back():
    kept = denoiser_blocks.attend
    with explicit_attention():
        assert denoiser_blocks.attend is shared_attention.attend is not kept
        q = torch.randn(1, 2, 5, 8)
        torch.testing.assert_close(denoiser_blocks.attend(q, q, q), kept(q, q, q))
    assert denoiser_blocks.attend is shared_attention.attend is kept


def test_scores_that_do_not_fit_are_not_made(monkeypatch):
    monkeypatch.setattr(completion_timing, "free_bytes", lambda device: 1000)
    said = compare_attention(timed(), repeat=1)
    assert isinstance(said, str) and "not compared" in said


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
