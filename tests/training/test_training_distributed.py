from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from training_runs import on_two, sets

from gvtools.completers.geoverse import GeoVerse, from_pretrained
from gvtools.completers.geoverse.config import GeoVerseConfig, read
from gvtools.completers.geoverse.weights import save_pretrained
from gvtools.networks.config_json import to_json
from gvtools.training.data import TrainingSamples
from gvtools.training.options import SHIPPED, shipped_or_read
from gvtools.training.records import read_log
from gvtools.training.samples import Draws
from gvtools.training.stages import DenoiserStage
from pipelines.cli import main

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

SHARDED = sets("parallel=sharded")
STEPS = 3
# Two processes' samples lie in different groups, so that their numbers of context views differ.
LARGE = sets(f"denoiser.optimizer.steps={STEPS}", "denoiser.optimizer.batch=16")
PARTS = sets("denoiser.optimizer.accumulate=2")


def arguments(training: str, stage: str, out: Path, *more: str) -> list[str]:
    return ["train", training, "--stage", stage, "--out", str(out), "--device", "cpu", *more]


def train_on_two(training: str, stage: str, out: Path, *more: str) -> str:
    return on_two(*arguments(training, stage, out, *more))


def same_record(found: Path, wanted: Path) -> None:
    """The last records of two stages agree, but for what is no mean over samples."""
    one, two = read_log(wanted)[-1], read_log(found)[-1]
    assert one.keys() == two.keys()
    for name, value in one.items():
        if name not in ("seconds", "depth_rel", "rgb_psnr") and not name.endswith("_pixels"):
            assert math.isfinite(value)
            assert two[name] == pytest.approx(value, rel=1e-4), json.dumps([one, two])


def tensors(stage: Path) -> dict[str, torch.Tensor]:
    return from_pretrained(stage / "weights", video=False).state_dict()


def same_weights(found: Path, wanted: Path) -> None:
    """Equal but for rounding, which Adam blows up to a step where a gradient is next to nothing."""
    one, two = tensors(wanted), tensors(found)
    apart = sum(int(((one[name] - two[name]).abs() > 1e-5).sum()) for name in one)
    assert apart <= 1e-3 * sum(tensor.numel() for tensor in one.values())


def same_gradients(found: Path, wanted: Path, most: float) -> None:
    """Of the one step that was made, as Adam's averages have them; of every parameter.

    They differ by a share of the norm, and by a millionth of the greatest one, which is what
    rounding leaves of a gradient that is 0.
    """
    one, two = (
        torch.load(stage / "state.pt", weights_only=True)["optimizer"]["state"]
        for stage in (wanted, found)
    )
    assert one.keys() == two.keys()
    greatest = max(float(entry["exp_avg"].norm()) for entry in one.values())
    for index, entry in one.items():
        gradient, other = entry["exp_avg"], two[index]["exp_avg"]
        assert float((gradient - other).norm()) <= most * float(gradient.norm()) + 1e-6 * greatest


def model_of(config: GeoVerseConfig) -> GeoVerse:
    torch.manual_seed(5)
    model = GeoVerse(config)
    for parameter in model.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.05)
    return model


@pytest.fixture(scope="module")
def start(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("start")
    save_pretrained(model_of(read(SHIPPED / "micro_model.json")), folder)
    return folder


@pytest.fixture(scope="module")
def one(start, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("one")
    more = ["--init", str(start), "--sheets", str(STEPS), *LARGE, *PARTS, "--quiet"]
    assert main(arguments("micro", "denoiser", out, *more)) == 0
    return out / "denoiser"


@pytest.fixture(scope="module")
def two(start, tmp_path_factory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("two")
    more = ["--init", str(start), "--sheets", str(STEPS), *LARGE, *PARTS, *SHARDED]
    return out / "denoiser", train_on_two("micro", "denoiser", out, *more)


def test_two_processes_that_share_parameters_out_see_what_one_would(one, two):
    config, folder = shipped_or_read("micro")
    samples = TrainingSamples(config, config.network(folder))
    contexts = [samples.batch(range(n, n + 1)).views.context for n in range(0, 16 * STEPS, 8)]
    assert any(a != b for a, b in zip(contexts[::2], contexts[1::2], strict=True))
    same_record(two[0], one)
    same_weights(two[0], one)
    pictures = [
        np.asarray(Image.open(stage / "sheets" / f"step_{STEPS:06d}.png"), dtype=float)
        for stage in (one, two[0])
    ]
    assert np.abs(pictures[0] - pictures[1]).mean() < 0.1


def test_each_of_them_holds_its_half_of_what_is_trained(start, two):
    pattern = r"share ([\d,]+) parameters out, the first holds ([\d,]+) of them; ([\d,]+)"
    said = re.search(pattern, two[1])
    assert said is not None, two[1]
    shared, own, whole = (int(number.replace(",", "")) for number in said.groups())
    model = from_pretrained(start)
    counts = {
        name: sum(p.numel() for p in part.parameters()) for name, part in model.named_children()
    }
    # Stages before its own leave the refiner out.
    counts.pop("refiner", None)
    frozen = sum(p.numel() for n, p in model.named_parameters() if n.endswith("t_embedder.W"))
    assert whole <= counts["geometry"] + frozen
    assert shared + whole == sum(counts.values())
    assert own == pytest.approx(shared / 2, rel=0.02)


def test_what_they_save_goes_on_exactly_and_in_one_process(start, one, two, tmp_path):
    more = ["--init", str(start), *LARGE, *PARTS]
    train_on_two("micro", "denoiser", tmp_path / "a", *more, *SHARDED, "--until", "1")
    assert not (tmp_path / "a" / "denoiser" / "weights").exists()
    shutil.copytree(tmp_path / "a", tmp_path / "b")

    more += ["--resume", "--sheets", "0"]
    train_on_two("micro", "denoiser", tmp_path / "a", *more, *SHARDED)
    whole, parts = tensors(two[0]), tensors(tmp_path / "a" / "denoiser")
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    # One process shares nothing out, whatever the setting.
    assert main(arguments("micro", "denoiser", tmp_path / "b", *more, *SHARDED, "--quiet")) == 0
    same_weights(tmp_path / "b" / "denoiser", one)


def test_a_batch_that_is_bad_in_one_process_is_skipped_by_both(start, tmp_path):
    """Also where the one goes on to its backward pass, in which the processes meet."""
    config, folder = shipped_or_read("micro")
    model = from_pretrained(start, config=config.network(folder))
    stage, samples = DenoiserStage(model, config.denoiser), TrainingSamples(config, model.config)
    losses = [
        float(stage(samples.batch(part), Draws(0, "denoiser", 0, tuple(part)))[0].detach())
        for part in (range(0, 4), range(4, 8))
    ]
    most = sum(losses) / 2
    assert min(losses) < 0.99 * most
    more = ["--init", str(start), "--sheets", "0", "--set", "denoiser.optimizer.batch=8"]
    more += ["--set", "denoiser.optimizer.steps=4"]
    more += ["--set", f"denoiser.optimizer.largest_loss={most}"]
    assert main(arguments("micro", "denoiser", tmp_path / "one", *more, *PARTS, "--quiet")) == 0
    train_on_two("micro", "denoiser", tmp_path / "two", *more, *SHARDED)
    assert 0 < read_log(tmp_path / "one" / "denoiser")[-1]["skipped"] < 4
    same_record(tmp_path / "two" / "denoiser", tmp_path / "one" / "denoiser")


def test_teacher_and_video_prior_are_shared_out_as_well(tmp_path):
    pytest.importorskip("diffusers", reason="the extra wan is not installed")
    import published_folder
    import tiny_wan

    micro = read(SHIPPED / "micro_model.json")
    config = replace(
        micro,
        video=replace(tiny_wan.CONFIG, prompt="zeros"),
        injection="control",
        level1=replace(micro.level1, depth=4),
        control=replace(micro.control, layers=(0, 1, 2, 3)),
    )
    folder = tmp_path / "start"
    published_folder.write_published(model_of(config), folder)
    tiny_wan.transformer().save_pretrained(folder / "video" / "transformer")
    tiny_wan.vae().save_pretrained(folder / "video" / "vae")
    (tmp_path / "model.json").write_text(json.dumps(to_json(config)))
    data = json.loads((SHIPPED / "micro.json").read_text())
    data["model"] = "model.json"
    data["reflow"]["cfg_scale"] = 1.5
    stages = ("denoiser", "reflow", "heads")
    for stage in stages:
        data[stage]["optimizer"]["steps"] = 1
    training = tmp_path / "training.json"
    training.write_text(json.dumps(data))
    more = ["--init", str(folder), "--sheets", "1"]
    # The same samples together: the video prior's noise goes by a sample's place among them.
    both = [f"{stage}.optimizer.accumulate=2" for stage in stages]
    parts = [*(word for text in both for word in ("--set", text)), "--quiet"]
    assert main(arguments(str(training), "all", tmp_path / "one", *more, *parts)) == 0
    train_on_two(str(training), "all", tmp_path / "two", *more, *SHARDED)
    for stage in stages:
        same_record(tmp_path / "two" / stage, tmp_path / "one" / stage)
        # A later stage starts from weights that are the same but for rounding (``same_weights``).
        most = 1e-4 if stage == stages[0] else 1e-2
        same_gradients(tmp_path / "two" / stage, tmp_path / "one" / stage, most)
        assert (tmp_path / "two" / stage / "weights" / "video" / "vae").is_dir()
        assert from_pretrained(tmp_path / "two" / stage / "weights").video is not None


THREADS = Path("/proc/self/task")
PROGRAM = """
import sys
from pathlib import Path

import torch
import torch.distributed as dist

from gvtools.training.distributed import join_processes


def threads() -> int:
    return sum("gloo" in name.read_text() for name in Path("/proc/self/task").glob("*/comm"))


with join_processes("cpu") as processes:
    import torch._dynamo  # as optimizers do, on their first step

    dist.all_reduce(torch.ones(3))
    before = threads()
print(f"threads {before} then {threads()}.")
"""


@pytest.mark.skipif(not THREADS.exists(), reason="the system lists no threads in /proc")
def test_no_thread_of_the_group_outlives_it(tmp_path):
    """One that did could abort the process at its end."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    said = on_two(program)
    assert said.count("then 0.") == 2 and "threads 0" not in said
