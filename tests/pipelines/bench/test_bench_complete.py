from __future__ import annotations

import importlib.util
import json
import weakref
from collections.abc import Callable

import geoverse_models as micro
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from command_line import run_command

from benchmarks.memory import CASES, peak, predicted_peak
from gvtools.completers.geoverse import model as stages
from gvtools.completers.geoverse.config import named
from gvtools.completers.geoverse.flow import time_grid
from gvtools.completers.geoverse.model import LEVEL0, LEVEL1
from gvtools.errors import OptionError
from gvtools.networks.compute import attend
from pipelines.bench import open3d_peers, procedural_cloud, side_by_side
from pipelines.bench.complete import (
    INSIDE,
    StageClock,
    TimedPass,
    module_bytes,
    parameters,
    random_features,
    random_model,
    random_video,
    random_views,
    total,
)
from pipelines.bench.memory import (
    LiveBytes,
    StagePeaks,
    alone,
    away_bytes,
    card_line,
    fake_tensors,
)
from pipelines.bench.prediction import ASKED, CARDS, LEAST, Card, Counter, Kernel, Work, row_of

pytestmark = pytest.mark.usefixtures("one_thread")

TERA = 1e12
INSIDE_DECODING = [f"decoding: {part}" for part in ("encoder blocks", "geometry head", "RGB head")]
STAGES = ["hint encoding", "level-1 step 1", "level-1 step 2", "cascade step 1", "decoding"]
STAGES += [*INSIDE_DECODING, "between stages", "pass"]


def bench(*words: object) -> None:
    run_command("bench", *words)


# Counting.


def timed(config, *, context: int = 1, targets: int = 2, steps: int = 1) -> TimedPass:
    batch = random_views((32, 32), context=context, targets=targets)
    return TimedPass(
        micro.model(config),
        batch,
        sampling={"bounds": time_grid(steps), "cascade_bounds": time_grid(1)},
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


def figures(tmp_path, *words: object) -> dict:
    file = tmp_path / "complete.json"
    bench("complete", *words, "--json", file)
    return json.loads(file.read_text())


def predicted(capsys, tmp_path, *words: object) -> tuple[str, dict]:
    """What the command says, and its figures."""
    given = ("--weights", micro.weights_folder(tmp_path / "weights"), *words)
    bench("complete", *given)
    return capsys.readouterr().out, figures(tmp_path, *given)


def test_table_and_figures_of_a_run(tmp_path, capsys):
    words = "--targets 2 --steps 2 --repeat 2 --device cpu --size 24x32"
    shown, data = predicted(capsys, tmp_path, *words.split())
    assert "2 + 2 views of 24x32, 2 + 1 steps, cpu, float32" in shown
    for name in (*STAGES, "level-1 denoiser", "first pass", "peak", "TFLOP/s"):
        assert name in shown
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
    assert data["config"] == "micro" and data["weights"] == str(tmp_path / "weights")
    assert data["size"] == [24, 32] and data["precision"] == "float32" and data["video"] is False
    assert data["weights_bytes"] == module_bytes(micro.model())
    assert data["first_pass_s"] > 0


def test_a_video_prior_that_is_not_run_has_a_stand_in(tmp_path):
    folder = micro.weights_folder(tmp_path / "w", micro.config(injection="control"))
    words = "--targets 1 --steps 1 --repeat 1 --device cpu --size 32 --no-video"
    data = figures(tmp_path, "--weights", folder, *words.split())
    assert data["video_stand_in"] and data["video"] is False
    names = [row["name"] for row in data["results"]]
    assert "video features" in names
    assert data["parameters"]["control branch"] > 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("complete --size 50", "multiples of 12"),
        ("complete --size 5y5", "expected HxW or N"),
        ("complete --steps 0", "steps"),
        ("complete --points 5000", "--points: of fuse and splat"),
        ("complete --video", "tiny has no video prior"),
        ("complete --config tiny --weights x", "both --config and --weights"),
        ("complete --card 24", "--card is of --memory"),
        ("complete --memory --compile", "expected one of --memory"),
        ("complete --memory --card 0", "more than 0"),
        ("fuse --steps 3 --compile", "--compile, --steps given"),
        ("fuse --points 10", "--points 10; expected at least 1000"),
        ("splat --repeat 0", "--repeat 0; expected at least 1"),
    ],
)
def test_options_that_do_not_fit(words, said):
    with pytest.raises(OptionError, match=said):
        bench(*words.split())


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


# Predicted memory.


def test_bytes_are_counted_once_and_forgotten_when_they_are_given_back():
    with LiveBytes() as live:
        a = torch.zeros(100)
        assert live.live == 400
        b = a.view(10, 10)[2:].t()
        a.add_(1)
        assert live.live == 400
        c = a + b.sum()
        assert live.live == 800 and live.peak == 804
        del a
        assert live.live == 800  # ``b`` still looks at it
        del b
        assert live.live == 400 and live.peak == 804
        live.forget_peak()
        assert live.peak == 400
        del c
    assert live.live == 0


def test_weights_are_counted_elsewhere():
    layer = torch.nn.Linear(10, 30)
    x = torch.zeros(5, 10)
    with LiveBytes([layer]) as live:
        y = layer(x)
        assert live.peak == 5 * 30 * 4
        y.sum().backward()
        del y
        assert live.live == (10 * 30 + 30) * 4  # the gradients


def test_nothing_is_allocated_for_what_is_predicted():
    with fake_tensors(), LiveBytes() as live:
        made = torch.zeros(2**40)
        made = made * 2
        assert live.live == 4 * 2**40
        alive = weakref.ref(made)
        del made
        assert alive() is None and live.live == 0 and live.peak == 8 * 2**40


def test_peaks_by_stage():
    with LiveBytes() as live:
        peaks = StagePeaks(live)
        with peaks("hint encoding"):
            kept = torch.zeros(100)
        with peaks("decoding"):
            torch.zeros(50).sum()
            with peaks("RGB head"):
                torch.zeros(200)
    assert len(kept) == 100
    assert peaks.rows == {"hint encoding": 400, "decoding": 1200, "decoding: RGB head": 1200}


@pytest.mark.slow
def test_what_is_predicted_is_what_is_counted_with_numbers():
    found = {case: alone(predicted_peak, case, "tiny", 48) for case in CASES}
    for case, before in found.items():
        assert before == pytest.approx(alone(peak, case, "tiny", 48), rel=0.01)
    assert all(found.values())


@pytest.mark.slow
def test_the_tables_and_figures_of_memory(tmp_path, capsys):
    words = "--size 32 --memory --steps 1 --targets 1 --precision float16 --card 24"
    shown, found = predicted(capsys, tmp_path, *words.split())
    for said in (
        "micro, 2 + 1 views of 32x32, 1 + 1 steps, float16: peak memory of a pass, GB",
        "a training step of one sample, float32",
        "reflow",
        "level-1 step",
        "a card of 24 GB: a pass without the video prior fits (0.",
    ):
        assert said in shown
    assert found["precision"] == "float16" and found["card_gb"] == 24
    assert len(found["training"]) == 4
    for row in found["training"]:
        assert row["total_bytes"] >= row["lasting_bytes"] > row["weights_bytes"] > 0


@pytest.mark.skipif(importlib.util.find_spec("diffusers") is None, reason="needs diffusers")
def test_of_a_visiting_prior_two_blocks_are_on_the_card():
    import tiny_wan

    # A video model's first block of the branch is its largest, by a layer of its own.
    model, network = micro.model(micro.config()), tiny_wan.transformer(5, (0, 2, 4))
    assert away_bytes(model) == 0
    model.attach_video(tiny_wan.prior(network))
    plain, branch = module_bytes(network.blocks[0]), module_bytes(network.vace_blocks[1])
    assert plain < branch < module_bytes(network.vace_blocks[0])
    assert away_bytes(model) == 5 * plain + branch


def test_what_fits_a_card():
    figures = {
        "inference": [{"model": "M", "total_bytes": 3e9}, {"model": "M", "total_bytes": 7e9}],
        "training": [
            {"model": "M", "stage": "S", "recompute": False, "total_bytes": 30e9},
            {"model": "M", "stage": "S", "recompute": True, "total_bytes": 9e9},
        ],
    }
    assert card_line(figures, 8) == (
        "a card of 8 GB: a pass M fits (7); training S M and with recompute does not fit (9)"
    )


# Predicted time.


def kernels(*calls: Callable[[], object]) -> list[Kernel]:
    with Work() as work:
        for call in calls:
            call()
    return [*work.stages.get("between stages", Counter()).elements()]


def test_a_product_reads_and_writes_every_number_once():
    a, b = torch.rand(3, 4), torch.rand(4, 5)
    product = Kernel("product", "float32", 2 * 3 * 4 * 5, 4 * (12 + 20 + 15))
    assert kernels(lambda: a @ b) == [product]
    assert kernels(a.bfloat16) == [Kernel("product", "half", 0, 4 * 12 + 2 * 12)]
    added = Kernel("product", "float32", 0, 4 * (12 + 1 + 12))
    assert kernels(lambda: a.add_(b[:1, :1].expand(3, 4))) == [added]
    assert not kernels(lambda: a.view(2, 6)[1:].t(), lambda: torch.empty(100))


def test_convolutions_and_attention_have_rates_of_their_own():
    x, weights = torch.rand(1, 3, 8, 8), torch.rand(5, 3, 3, 3)
    (kernel,) = kernels(lambda: F.conv2d(x, weights))
    assert (kernel.work, kernel.kind) == ("convolution", "tf32")
    assert kernel.flops == 2 * 5 * 36 * 27
    q = torch.rand(1, 2, 16, 8, requires_grad=True)
    found = kernels(lambda: F.scaled_dot_product_attention(q, q, q).sum().backward())
    forward, backward = (kernel for kernel in found if kernel.work == "attention")
    # Two products of (16, 8, 16) for each of two heads; five in the backward pass.
    assert forward.flops == 2 * 2 * 2 * 16 * 16 * 8 and backward.flops == 2.5 * forward.flops
    assert forward.heads == backward.heads == 8


def test_a_kernel_takes_as_long_as_the_slower_of_its_two():
    card = Card("C", bandwidth=1, half=100, tf32=50, float32=10)
    assert Kernel("product", "half", 8 * 10**11, 10).seconds(card) == pytest.approx(0.01)
    assert Kernel("product", "half", 10, 2 * 10**12).seconds(card) == pytest.approx(2)
    assert Kernel("attention", "float32", 4 * 10**12, 0, 64).seconds(card) == pytest.approx(2)
    small = Kernel("product", "half", 1, 1)
    assert small.seconds(card) == LEAST
    seconds = row_of("S", Counter({small: 1000}))["seconds"]
    assert seconds == {one.name: pytest.approx(1000 * ASKED) for one in CARDS}


def test_the_operations_of_a_pass_are_those_that_torch_counts():
    model = micro.model()
    views = random_views((32, 32), context=1, targets=2)
    sampling = {"bounds": (1.0, 0.5, 0.0), "cascade_bounds": (1.0, 0.0)}
    counted = TimedPass(model, views, sampling=sampling).flops()
    with Work() as work:
        model.clock = work.clock
        model.generate(views, **sampling)
    found = {stage: row_of(stage, kernels)["flops"] for stage, kernels in work.stages.items()}
    assert found["level-1 step"] == counted["level-1 step 1"] + counted["level-1 step 2"]
    assert found["cascade step"] == counted["cascade step 1"]
    inside = [name for name in counted if name.startswith(INSIDE)]
    assert len(inside) == 3
    for name in ("hint encoding", *inside):
        assert found[name] == counted[name] > 0, name


@pytest.mark.slow
def test_the_table_and_figures_of_predicted_time(tmp_path, capsys):
    shown, found = predicted(capsys, tmp_path, "--size", 32, "--predict", "--steps", 2)
    assert "micro, 2 + 6 views of 32x32, 2 + 1 steps, bfloat16, not compiled" in shown
    assert "RTX 3090" in shown
    *stages, whole = found["results"]
    assert whole["name"] == "pass"
    for name in ("flops", "bytes", "kernels"):
        assert whole[name] == sum(row[name] for row in stages) > 0
    assert set(whole["seconds"]) == {card.name for card in CARDS}


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch):
    monkeypatch.setattr(side_by_side, "SETTLE_SECONDS", 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(("what", "rows"), [("fuse", 2), ("splat", 5)])
def test_table_and_json_have_both_times_and_their_ratio(tmp_path, capsys, what, rows):
    bench(what, "--points", 2_000, "--repeat", 1)
    out = capsys.readouterr().out
    assert out.count("Open3D") >= rows and "ratio" in out
    file = tmp_path / "bench.json"
    bench(what, "--points", 2_000, "--repeat", 1, "--json", file)
    data = json.loads(file.read_text())
    assert len(data["results"]) == rows
    for row in data["results"]:
        assert row["ours_s"] > 0 and row["peer_s"] > 0 and "Open3D" in row["peer"]
        assert row["ratio"] == pytest.approx(row["ours_s"] / row["peer_s"])
        assert row["ratio_of_minima"] == pytest.approx(row["ours_min_s"] / row["peer_min_s"])
        assert row["ours_min_s"] <= row["ours_s"]


@pytest.mark.slow
def test_calls_take_turns_and_warm_ups_are_not_counted():
    seen: list[tuple[str, int]] = []
    seconds = side_by_side.alternate(
        [lambda turn: seen.append(("a", turn)), lambda turn: seen.append(("b", turn))], 2
    )
    assert seen == [(name, turn) for turn in range(3) for name in "ab"]
    assert [len(kept) for kept in seconds] == [2, 2]
    seen.clear()
    side_by_side.alternate([lambda turn: seen.append(("a", turn))], 1, steady=True)
    assert seen == [("a", 0), ("a", 0), ("a", 1), ("a", 1)]


def test_walls_fill_one_voxel_each():
    voxel = 0.1
    size = procedural_cloud.box_size(4000, voxel)
    sets = procedural_cloud.walls(size, voxel)
    points = np.concatenate([points.positions for points in sets]).astype(np.float64)
    cells = np.unique(np.floor(points / voxel).astype(int), axis=0)
    # Points keep half a voxel from the borders; neighbouring walls share their edges alone.
    assert np.abs(points / voxel - np.floor(points / voxel) - 0.5).max() < 1e-3
    assert len(cells) == pytest.approx(4000, rel=0.15)
    n = np.round(size / voxel).astype(int) + 1
    assert len(cells) == np.prod(n) - np.prod(n - 2)


def test_the_peers_see_the_same_scene():
    """Open3D's ray casting and point projection, called as here, give the exact depth."""
    size = np.array([3.0, 2.0, 2.4])
    volume = open3d_peers.TsdfVolume(0.02, blocks=4000)
    for turn in (0.0, 0.1, 0.2):
        camera = procedural_cloud.inside_camera(size, turn=turn, width=160, height=120)
        rgb, depth = procedural_cloud.photograph(size, camera)
        volume.integrate(*open3d_peers.images(rgb, depth), camera)
    camera = procedural_cloud.inside_camera(size, turn=0.1, width=160, height=120)
    rgb, depth = procedural_cloud.photograph(size, camera)
    cast_rgb, cast_depth = volume.ray_cast(camera)
    seen = cast_depth > 0
    assert seen.mean() > 0.7
    # Within a voxel, which is as exact as the volume gets.
    assert np.median(np.abs(cast_depth - depth)[seen]) < 0.02
    assert np.median(np.abs(cast_rgb * 255 - rgb)[seen]) < 6
    pose = camera.world_from_cam[0]
    points = (camera.rays() * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    cloud = open3d_peers.cloud(
        points.reshape(-1, 3).astype(np.float32), rgb.reshape(-1, 3).astype(np.float32) / 255
    )
    flat_rgb, flat_depth = open3d_peers.one_pixel(cloud, camera)
    # Every point comes back to the centre of its own pixel: the half pixel is right.
    np.testing.assert_allclose(flat_depth, depth, rtol=1e-5)
    np.testing.assert_allclose(flat_rgb * 255, rgb, atol=1e-3)


def test_one_pixel_winners_agree():
    rows = side_by_side.one_pixel_rows(30_000, repeat=1)
    share = float(rows[0].note.split("winner in ")[1].split("%")[0])
    assert share > 99.9
