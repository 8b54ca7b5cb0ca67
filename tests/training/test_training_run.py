from __future__ import annotations

import json
import os
import re
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from training_runs import on_two, sets

from gvtools.completers.geoverse import from_pretrained
from gvtools.errors import OptionError
from gvtools.settings import with_texts
from gvtools.training import loop
from gvtools.training.data import TrainingSamples
from gvtools.training.options import EncoderStageOptions, OptimizerOptions, shipped_or_read
from gvtools.training.records import TrainingLog, read_log
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("one_thread")

SHORT = ["--device", "cpu", "--sheets", "0", "--quiet"]
SAMPLES: list[str] = []


@pytest.fixture(scope="module", autouse=True)
def samples(tmp_path_factory):
    """The same few samples for every training, made once; a record every few steps."""
    pool = f"data.cache={tmp_path_factory.mktemp('pool')}"
    SAMPLES[:] = sets("data.pool=8", "data.size=[24,24]", pool, "encoder.statistics=1")
    SAMPLES.extend(sets(*(f"{stage}.optimizer.batch=2" for stage in COUNTS)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "LOG_EVERY", 4)
        yield


def train(out: Path, stage: str, *more: str) -> int:
    start = ["train", "micro", "--stage", stage, "--out", str(out)]
    return main([*start, *SHORT, *SAMPLES, *more])


def steps(stage: str, count: int) -> list[str]:
    return sets(f"{stage}.optimizer.steps={count}")


def weights_of(folder: Path) -> dict[str, torch.Tensor]:
    return from_pretrained(folder / "weights").state_dict()


# Steps of each stage.
COUNTS = {"encoder": 8, "denoiser": 4, "reflow": 3, "heads": 3, "refiner": 3}


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("training")
    torch.set_num_threads(1)
    for stage, count in COUNTS.items():
        assert train(out, stage, *steps(stage, count)) == 0
    return out


def test_the_loss_falls_and_every_stage_leaves_weights_that_load(trained):
    records = read_log(trained / "encoder")
    assert records[-1]["step"] == 8
    assert records[-1]["loss"] < records[0]["loss"]
    encoder = from_pretrained(trained / "encoder" / "weights")
    assert not encoder.config.trained
    assert float(encoder.level_statistics[1].var.std()) > 0
    assert from_pretrained(trained / "reflow" / "weights").config.trained
    # The student's stage moves level 1 alone.
    names = moved(trained / "denoiser", trained / "reflow")
    assert names and all(name.startswith("level1.") for name in names)


def moved(before: Path, after: Path) -> set[str]:
    one, two = weights_of(before), weights_of(after)
    return {name for name, tensor in two.items() if not torch.equal(tensor, one[name])}


def of_rays(name: str) -> bool:
    return name.startswith("geometry.head.") and "_aux" in name


def test_the_stage_of_the_heads_moves_them_alone(trained):
    names = moved(trained / "reflow", trained / "heads")
    colors = {name for name in names if name.startswith("rgb_head.")}
    rays = {name for name in names if of_rays(name)}
    assert colors and rays
    # Layers that depth and rays share stay, since both are told from other features.
    depth = names - colors - rays
    assert depth and all(
        name.startswith(("geometry.head.scratch.refinenet", "geometry.head.scratch.output_conv"))
        for name in depth
    )
    assert from_pretrained(trained / "heads" / "weights").config.trained
    record = read_log(trained / "heads")[-1]
    for name in ("origin", "direction", "rgb", "hf", "rgb_decoded", "depth", "depth_decoded"):
        assert 0 < record[name] < 10, name


def test_the_last_stage_adds_a_refiner_and_moves_nothing_else(trained):
    before, after = weights_of(trained / "heads"), weights_of(trained / "refiner")
    assert all(torch.equal(after[name], tensor) for name, tensor in before.items())
    assert set(after) - set(before) and all(
        name.startswith("refiner.") for name in set(after) - set(before)
    )
    assert from_pretrained(trained / "heads" / "weights").config.refiner is None
    assert from_pretrained(trained / "refiner" / "weights").config.trained
    record = read_log(trained / "refiner")[-1]
    assert {"color", "depth_right", "psnr", "gain"} <= set(record)
    assert 0 < record["depth_right"] < 2 and 3 < record["psnr"] < 60


def test_an_earlier_stage_leaves_the_refiner_of_its_start_out(trained, tmp_path):
    start = ["--init", str(trained / "refiner" / "weights")]
    assert train(tmp_path, "heads", *steps("heads", 1), *start) == 0
    assert from_pretrained(tmp_path / "heads" / "weights").refiner is None
    assert train(tmp_path / "again", "refiner", *steps("refiner", 1), *start) == 0
    names = moved(trained / "refiner", tmp_path / "again" / "refiner")
    assert names and all(name.startswith("refiner.") for name in names)


def test_a_head_of_weight_0_stays_as_it_is(trained, tmp_path):
    shutil.copytree(trained / "reflow", tmp_path / "reflow")
    rays = [*sets("heads.rgb=0", "heads.depth=0"), *steps("heads", 1)]
    assert train(tmp_path, "heads", *rays) == 0
    names = moved(trained / "reflow", tmp_path / "heads")
    assert names and all(of_rays(name) for name in names)
    assert set(read_log(tmp_path / "heads")[-1]).isdisjoint({"rgb", "depth"})


def test_a_training_without_that_stage_says_so(tmp_path, capsys):
    out = str(tmp_path / "base")
    assert main(["train", "base", "--rooms", "--stage", "heads", "--out", out]) == 2
    assert "this training has no stage heads" in capsys.readouterr().err


def test_a_resumed_training_is_the_uninterrupted_one(trained, tmp_path):
    again = tmp_path / "again"
    assert train(again, "encoder", *steps("encoder", 8), "--until", "3") == 0
    assert not (again / "encoder" / "weights").exists()
    assert train(again, "encoder", *steps("encoder", 8), "--resume") == 0
    assert not moved(trained / "encoder", again / "encoder")


@pytest.mark.slow
@pytest.mark.parametrize(("before", "stage"), [*pairwise(COUNTS)])
def test_a_later_stage_resumes_exactly_as_well(trained, tmp_path, before, stage):
    count = COUNTS[stage]
    shutil.copytree(trained / before, tmp_path / before)
    assert train(tmp_path, stage, *steps(stage, count), "--until", "2") == 0
    assert not (tmp_path / stage / "weights").exists()
    assert train(tmp_path, stage, *steps(stage, count), "--resume") == 0
    assert not moved(trained / stage, tmp_path / stage)


def test_finished_stages_are_left_as_they_are(trained, tmp_path, capsys):
    """Else the next stage, whose state names its start by its bytes, might not go on."""
    shutil.copytree(trained, tmp_path / "out")
    out = tmp_path / "out"
    files = sorted(path for path in out.rglob("*") if path.is_file())
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}
    more = [word for stage, count in COUNTS.items() for word in steps(stage, count)]
    loud = [word for word in SHORT if word != "--quiet"]
    assert main(["train", "micro", "--out", str(out), *loud, *SAMPLES, *more, "--resume"]) == 0
    assert capsys.readouterr().out.count("finished before") == len(COUNTS)
    assert {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in files} == before


def test_all_stages_until_a_step_end_there(tmp_path):
    more = [*SHORT, *SAMPLES, *steps("encoder", 3), "--until", "2"]
    assert main(["train", "micro", "--out", str(tmp_path), *more]) == 0
    assert read_log(tmp_path / "encoder")[-1]["step"] == 2
    assert not (tmp_path / "denoiser").exists()


def test_a_student_is_sampled_by_the_bounds_that_it_was_distilled_for(trained, tmp_path):
    shutil.copytree(trained / "denoiser", tmp_path / "denoiser")
    bounds = ["--set", "reflow.bounds=[1,0.4,0]", "--set", "reflow.cfg_scale=1.5"]
    assert train(tmp_path, "reflow", *steps("reflow", 1), *bounds) == 0
    assert train(tmp_path, "heads", *steps("heads", 1), *bounds) == 0
    for stage in ("reflow", "heads"):
        flow = from_pretrained(tmp_path / stage / "weights").config.flow
        assert flow.level1 == (1, 0.4, 0) and flow.cfg_scale == 1
    own = from_pretrained(trained / "heads" / "weights").config.flow
    assert len(own.level1) == 4


@pytest.mark.parametrize("stage", ["reflow", "heads", "refiner"])
def test_what_learns_from_an_untrained_denoiser_is_refused(trained, tmp_path, capsys, stage):
    shutil.copytree(trained / "encoder", tmp_path / "encoder")
    assert train(tmp_path, stage) == 2
    assert "its denoisers are untrained" in capsys.readouterr().err
    assert not (tmp_path / stage).exists()


def test_an_unfinished_stage_is_not_passed_over(trained, tmp_path, capsys):
    shutil.copytree(trained / "denoiser", tmp_path / "denoiser")
    assert train(tmp_path, "reflow", *steps("reflow", 3), "--until", "1") == 0
    assert train(tmp_path, "heads", *steps("heads", 1)) == 2
    said = capsys.readouterr().err
    assert "stage reflow was begun and is not finished" in said and said.count("\n") == 1


def test_every_stage_draws_what_it_makes(trained, tmp_path):
    shutil.copytree(trained / "encoder", tmp_path / "encoder")
    for stage, out in (("encoder", tmp_path / "own"), ("denoiser", tmp_path)):
        assert train(out, stage, "--sheets", "1", *steps(stage, 2), "--until", "1") == 0
        with Image.open(out / stage / "sheets" / "step_000001.png") as sheet:
            picture = np.asarray(sheet)
        assert picture.shape[2] == 3 and picture.std() > 10


@pytest.mark.parametrize("where", ["out", "json"])
def test_results_that_cannot_be_written_are_refused_before_anything_is_trained(
    tmp_path, capsys, where
):
    (tmp_path / "file").write_text("")
    options = {
        "out": ["--out", str(tmp_path / "file")],
        "json": ["--out", str(tmp_path / "x"), "--json", str(tmp_path / "absent" / "x.json")],
    }
    assert main(["train", "micro", *SHORT, *options[where]]) == 2
    said = capsys.readouterr().err
    assert str(tmp_path) in said and said.count("\n") == 1
    assert not (tmp_path / "x").exists()


def test_batches_across_different_context_counts_are_refused_at_once(tmp_path, capsys):
    assert train(tmp_path, "encoder", "--set", "encoder.optimizer.batch=12") == 2
    assert "optimizer.batch = 12" in capsys.readouterr().err
    more = sets("encoder.optimizer.batch=16", "encoder.optimizer.accumulate=2")
    assert train(tmp_path, "encoder", *more, "--until", "1") == 0


def test_a_training_is_not_mixed_with_another(trained, tmp_path, capsys):
    assert train(trained, "encoder", *steps("encoder", 8)) == 2
    assert "--resume" in capsys.readouterr().err
    assert train(trained, "encoder", *steps("encoder", 25), "--resume") == 2
    assert "options.optimizer.steps = 8, now 25" in capsys.readouterr().err
    assert train(tmp_path / "new", "denoiser") == 2
    assert "run --stage encoder first" in capsys.readouterr().err
    assert train(tmp_path / "new", "encoder", "--set", "encoder.optimizer.stepz=3") == 2
    assert "did you mean 'encoder.optimizer.steps'" in capsys.readouterr().err
    assert main(["train", "huge", "--out", str(tmp_path / "x")]) == 2
    assert "known: base, micro, tiny" in capsys.readouterr().err


def test_a_torn_state_is_one_clear_line(trained, tmp_path, capsys):
    folder = tmp_path / "torn" / "encoder"
    folder.mkdir(parents=True)
    whole = (trained / "encoder" / "state.pt").read_bytes()
    (folder / "state.pt").write_bytes(whole[: len(whole) // 2])
    assert train(tmp_path / "torn", "encoder", "--resume") == 2
    assert "cannot be read" in capsys.readouterr().err


def test_bad_batches_are_skipped_and_counted(tmp_path):
    more = ["--set", "encoder.optimizer.largest_loss=1e-6", *steps("encoder", 2)]
    assert train(tmp_path, "encoder", *more) == 0
    assert read_log(tmp_path / "encoder")[-1]["skipped"] == 2
    state = torch.load(tmp_path / "encoder" / "state.pt", weights_only=True)
    loaded = loop.load_state(tmp_path / "encoder", state["identity"])
    assert loaded is not None and loaded.progress.skipped == 2


@pytest.mark.slow
def test_two_processes_see_what_one_would(tmp_path):
    arguments = ["train", "micro", "--stage", "encoder", *SHORT, *steps("encoder", 4)]
    arguments += ["--set", "encoder.statistics=1"]
    assert main([*arguments, "--out", str(tmp_path / "one")]) == 0
    on_two(*arguments, "--out", tmp_path / "two")
    one, two = (read_log(tmp_path / name / "encoder")[-1] for name in ("one", "two"))
    for name in ("loss", "depth", "rgb", "ray", "pose"):
        assert two[name] == pytest.approx(one[name], rel=1e-4), json.dumps([one, two])


def test_a_trained_model_is_packed_with_its_record(trained, tmp_path, capsys):
    out = tmp_path / "packed"
    assert main(["weights", "pack", str(trained), str(out)]) == 0
    assert str(trained / "refiner" / "weights") in capsys.readouterr().out
    student, packed = weights_of(trained / "refiner"), from_pretrained(out).state_dict()
    for name, tensor in student.items():
        assert torch.allclose(packed[name], tensor, rtol=2e-3, atol=1e-5), name
    whole = (trained / "refiner" / "weights" / "geoverse.safetensors").stat().st_size
    assert (out / "geoverse.safetensors").stat().st_size < 0.6 * whole
    settings = json.loads((out / "training_encoder.json").read_text())
    assert settings["encoder"]["optimizer"]["steps"] == 8 and settings["data"]["cache"] is None
    last = json.loads((out / "log_reflow.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 3
    shutil.copytree(trained, tmp_path / "again")
    os.utime(tmp_path / "again" / "reflow" / "weights" / "geoverse.safetensors")
    assert main(["weights", "pack", str(tmp_path / "again"), str(out)]) == 2
    assert "an earlier stage made" in capsys.readouterr().err
    for later in ("heads", "refiner"):
        shutil.rmtree(tmp_path / "again" / later)
    assert main(["weights", "pack", str(tmp_path / "again"), str(out)]) == 0
    assert (out / "log_reflow.jsonl").exists() and not (out / "log_heads.jsonl").exists()
    assert main(["weights", "pack", str(tmp_path / "nothing"), str(out)]) == 2
    assert "no finished denoiser" in capsys.readouterr().err
    assert main(["weights", "pack", str(trained), str(trained / "inside")]) == 2
    assert "choose another folder" in capsys.readouterr().err


def test_auto_is_settled_once_said_and_kept(tmp_path, capsys, monkeypatch):
    from gvtools.networks import compute

    auto = sets("encoder.optimizer.precision=auto", "encoder.optimizer.steps=2")
    start = ["train", "micro", "--stage", "encoder", "--out", str(tmp_path), "--device", "cpu"]
    start += ["--sheets", "0", *SAMPLES, *auto]
    faster = [True]
    monkeypatch.setattr(compute, "bfloat16_is_faster", lambda: faster[0])
    assert main([*start, "--until", "1"]) == 0
    assert "encoder: products in bfloat16" in capsys.readouterr().out
    state = torch.load(tmp_path / "encoder" / "state.pt", weights_only=True)
    assert state["identity"]["options"]["optimizer"]["precision"] == "bfloat16"
    # The next start measures otherwise; the training stays what it was.
    faster[0] = False
    more = ("--set", "encoder.optimizer.recompute=true", "--resume")
    assert main([*start, *more]) == 0
    said = capsys.readouterr().out
    assert "encoder: products in bfloat16" in said and "goes on after step 1" in said
    assert (tmp_path / "encoder" / "weights").is_dir()
    assert main([*start, "--out", str(tmp_path / "new"), "--until", "1"]) == 0
    assert "encoder: products in float32" in capsys.readouterr().out


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
        ("encoder.optimizer.betas=x", "betas 'x'; expected a JSON list"),
        ("denoiser.weights.rgbs=1", "did you mean 'denoiser.weights.rgb'"),
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
