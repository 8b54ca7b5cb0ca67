from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_line import refused
from data_sets import mini_synthetic
from data_sets.miniature import Miniature, miniatures
from geoverse_models import awake
from safetensors.torch import save_file
from training_runs import ROOT, child

from gvtools.completers.geoverse import from_pretrained
from gvtools.completers.geoverse.config import GeoVerseConfig, named, read
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.video_prior import VideoPrior
from gvtools.completers.geoverse.wan import EMPTY_PROMPT
from gvtools.completers.geoverse.weights import save_pretrained
from gvtools.errors import DegenerateError
from gvtools.networks.config_json import to_json
from gvtools.scenes.data_sets.catalogue import load_spec, spec_names
from gvtools.scenes.project import open_collection
from gvtools.scenes.shard_writer import write_shards
from gvtools.training.data import MIXTURE, TrainingSamples, with_data
from gvtools.training.loader import batches
from gvtools.training.options import SHIPPED, TrainingSettings, shipped_or_read
from gvtools.training.records import read_log
from gvtools.training.samples import TrainingBatch
from gvtools.training.views import ContextChoice, ProceduralViews
from pipelines.cli import main


def test_the_file_has_the_fifteen_by_the_roots_of_their_frames():
    data = json.loads(MIXTURE.read_text())["data"]
    weights = {entry["root"]: entry["weight"] for entry in data["scenes"]}
    training = {name: load_spec(name) for name in spec_names()}
    training = {name: spec for name, spec in training.items() if "training" in spec.roles}
    assert set(weights) == set(training) and len(weights) == 15 and data["scene_share"] == 1
    for name, spec in training.items():
        assert weights[name] == pytest.approx(math.sqrt(spec.counts.images or 0), abs=1e-3)
        assert spec.geometry is not None
        own = 0 if name in ("realestate10k", "waymo") else 2 / 3
        assert spec.geometry.own_share == pytest.approx(own)


@pytest.fixture
def downloads(tmp_path: Path) -> Path:
    by_layout: dict[str, Miniature] = {m.layout: m for m in mini_synthetic.MINIATURES[::-1]}
    for name in ("gtasfm", "virtualkitti"):
        by_layout[load_spec(name).layout].write(tmp_path / "data" / name)
    (tmp_path / "data" / "spring").mkdir()
    (tmp_path / "data" / "mvssynth_estimated").mkdir()
    by_layout[load_spec("mvssynth").layout].write(tmp_path / "data" / "mvssynth")
    return tmp_path / "data"


def test_what_is_there_is_trained_on_by_its_share(downloads):
    config, found = with_data(shipped_or_read("base")[0], downloads)
    shares = {one.name: one.share for one in found}
    roots = [math.sqrt(load_spec(name).counts.images or 0) for name in ("gtasfm", "virtualkitti")]
    assert shares["gtasfm"] == pytest.approx(roots[0] / sum(roots), abs=1e-4)
    assert sum(shares.values()) == pytest.approx(1) and sum(map(bool, shares.values())) == 2
    notes = {one.name: one.note for one in found}
    assert "no scene of Spring" in notes["spring"] and "no folder" in notes["waymo"]
    assert "mvssynth_estimated: is empty" in notes["mvssynth"]
    assert "own geometry alone" in notes["gtasfm"] and len(found) == 15
    assert config.data.scene_share == 1 and len(config.data.scenes) == 2
    sources = TrainingSamples(config, config.network()).sources
    assert sources is not None and sources["rooms"]["share"] == 0
    assert sources["GTA-SfM"]["share"] == pytest.approx(shares["gtasfm"])


def test_it_does_not_begin_without_scenes(downloads, tmp_path, capsys):
    words = ["train", "base", "--out", str(tmp_path / "out")]
    assert "--rooms for drawn rooms alone" in refused(capsys, *words)
    assert "not a folder" in refused(capsys, *words, "--data", str(tmp_path / "absent"))
    both = refused(capsys, *words, "--data", str(downloads), "--rooms")
    assert "--data and --rooms: expected one" in both
    start = refused(capsys, *words, "--data", str(downloads), "--sheets", "0")
    assert "needs weights to start from; give --init DIR (gvtools weights fetch)" in start
    shutil.rmtree(tmp_path / "out")
    for name in ("gtasfm", "virtualkitti", "mvssynth"):
        shutil.rmtree(downloads / name)
    assert "none of the 15 data sets can be used" in refused(
        capsys, *words, "--data", str(downloads)
    )
    assert not (tmp_path / "out").exists()
    assert TrainingSettings().data.scene_share == 0


# --- all fifteen, through the paper's two stages ----------------------------------------------

# Whose depth the paper does not take, or that publish none.
ESTIMATED = ("dl3dv", "mapfree", "realestate10k", "waymo")


def written(root: Path, stack: ExitStack) -> list[str]:
    """A miniature of every data set of the mixture in its native layout; estimates of some."""
    by_layout = {miniature.layout: miniature for miniature in miniatures()[::-1]}
    names = [name for name in spec_names() if "training" in load_spec(name).roles]
    for name in names:
        miniature = by_layout[load_spec(name).layout]
        miniature.write(root / name)
        stack.enter_context(miniature.within())
    # The same room, with its true depth.
    for name in ESTIMATED:
        write_shards(open_collection("spec:gtasfm", root / "gtasfm"), root / f"{name}_estimated")
    return names


def base_in_small(size: int) -> GeoVerseConfig:
    """The form of ``base`` with few channels: its hints, objective, branch and video prior."""
    import tiny_wan

    base, micro = named("base"), read(SHIPPED / "micro_model.json")
    assert base.video is not None and base.cascade is not None and micro.cascade is not None
    video = replace(tiny_wan.CONFIG, resolution=(32, 32))
    return replace(
        base,
        image_size=size,
        views=micro.views,
        context=micro.context,
        geometry=micro.geometry,
        rgb=micro.rgb,
        level1=replace(micro.level1, depth=4),
        cascade=replace(micro.cascade, projective_size=size),
        video=video,
        control=replace(base.control, layers=video.taps),
    )


def start_of(config: GeoVerseConfig, folder: Path) -> Path:
    """A weights folder as a training of ``base`` begins with: denoisers, a branch of zeros."""
    import tiny_wan

    torch.manual_seed(0)
    model = GeoVerse(config)
    for denoiser in filter(None, (model.level1, model.cascade)):
        awake(denoiser)
    save_pretrained(model, folder)
    tiny_wan.transformer().save_pretrained(folder / "video" / "transformer")
    tiny_wan.vae().save_pretrained(folder / "video" / "vae")
    save_file({"embedding": tiny_wan.prompt()}, folder / "video" / EMPTY_PROMPT)
    return folder


def moved(before: Path, after: Path) -> set[str]:
    """The parts of the model in which a weight has changed."""
    old, new = (from_pretrained(folder, video=False).state_dict() for folder in (before, after))
    return {name.split(".")[0] for name in old if not torch.equal(old[name], new[name])}


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_all_fifteen_go_through_a_step_of_each_stage(tmp_path, monkeypatch, capsys):
    pytest.importorskip("diffusers", reason="the extra wan is not installed")
    size, step = 24, 64
    given: list[int] = []
    features = VideoPrior.features

    def counted(self: VideoPrior, images: torch.Tensor, *more: Sequence[object], **options: object):
        given.append(len(images))
        return features(self, images, *more, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(VideoPrior, "features", counted)
    config = base_in_small(size)
    start = start_of(config, tmp_path / "start")
    (tmp_path / "model.json").write_text(json.dumps(to_json(config)))
    with ExitStack() as stack:
        names = written(tmp_path / "data", stack)
        mixed, found = with_data(shipped_or_read("base")[0], tmp_path / "data")
        assert [one.name for one in found] == names and len(names) == 15
        whole = sum(math.sqrt(load_spec(name).counts.images or 0) for name in names)
        for one in found:
            root = math.sqrt(load_spec(one.name).counts.images or 0)
            assert one.share == pytest.approx(root / whole, abs=1e-4), one
        # As often as each other, so that a step meets all of them.
        scenes = [{**entry, "weight": 1.0} for entry in mixed.to_dict()["data"]["scenes"]]
        training = json.loads((SHIPPED / "base.json").read_text()) | {
            "model": "model.json",
            "parallel": "data",
            "data": {"views": 4, "size": [size, size], "workers": 0, "scenes": scenes,
                     "scene_share": 1.0, "scene_overlap": 0.0},
        }  # fmt: skip
        for stage, batch in (("denoiser", step), ("reflow", 8)):
            options = {"steps": 1, "batch": batch, "accumulate": batch // 8, "precision": "float32"}
            training[stage]["optimizer"] |= options
        (tmp_path / "training.json").write_text(json.dumps(training))
        out = tmp_path / "out"
        words = ["train", str(tmp_path / "training.json"), "--init", str(start), "--sheets", "0"]
        assert main([*words, "--out", str(out), "--device", "cpu"]) == 0
    record, last = (read_log(out / stage)[-1] for stage in ("denoiser", "reflow"))
    drawn = {name.split("/")[1]: n for name, n in record.items() if name.startswith("drawn/")}
    assert set(drawn) == {load_spec(name).name for name in names} and sum(drawn.values()) == step
    for name in ESTIMATED:
        title = load_spec(name).name
        assert record[f"geometry/{title}/estimated"] == drawn[title]
    for term in ("level1", "level0", "rgb", "hf", "depth"):
        assert math.isfinite(record[term]) and record[term] > 0, term
    assert record["skipped"] == last["skipped"] == 0 and record["gradient_norm"] > 0
    assert last["flow"] > 0 and math.isfinite(last["loss"]) and math.isfinite(last["reflow"])
    first, second = (out / stage / "weights" for stage in ("denoiser", "reflow"))
    assert moved(start, first) == {"level1", "cascade", "control"}
    assert moved(first, second) == {"level1", "control"}
    # The video model ran once a sample, also where a student has a teacher.
    assert sum(given) == step + 8
    packed = tmp_path / "packed"
    assert main(["weights", "pack", str(out), str(packed)]) == 0
    assert from_pretrained(packed).video is not None and (packed / "log_reflow.jsonl").is_file()
    said = capsys.readouterr().out
    assert all(f"of {load_spec(name).name}" in said for name in names)


DATA = ProceduralViews(views=3, size=(24, 24), context=ContextChoice(most=2, group=4))


def _equal(a: TrainingBatch, b: TrainingBatch) -> bool:
    names = ("images", "depth", "valid", "cam_from_world", "K")
    same = [torch.equal(getattr(a.views, name), getattr(b.views, name)) for name in names]
    return all(same) and torch.equal(a.images, b.images) and torch.equal(a.depth, b.depth)


@pytest.mark.slow
def test_workers_make_the_same_batches() -> None:
    parts = [range(4 * i, 4 * i + 4) for i in range(3)]
    plain = list(batches(DATA, parts, workers=0))
    before = torch.get_rng_state()
    made = batches(DATA, parts, workers=2)
    assert all(_equal(next(made), batch) for batch in plain[:2])
    made.close()
    continued = batches(DATA, parts[2:], workers=1)
    assert _equal(next(continued), plain[2])
    assert torch.equal(before, torch.get_rng_state())


class Refusing:
    def sample(self, index):
        raise DegenerateError(f"sample {index} cannot be drawn")

    def describe(self):
        return {}


# A process with a worker, as it goes on.
_PARENT = """
import multiprocessing, os, signal, time
from gvtools.errors import ProjectError
from gvtools.training.loader import batches
from gvtools.training.views import ContextChoice, ProceduralViews

if __name__ == "__main__":
    data = ProceduralViews(views=3, size=(24, 24), context=ContextChoice(most=2, group=4))
    made = batches(data, (range(2 * i, 2 * i + 2) for i in range(10_000)), workers=1)
    next(made)
    workers = [child.pid for child in multiprocessing.active_children()]
"""
_WAITING = """
    print(*workers, flush=True)
    time.sleep(600)
"""
_KILLING = """
    os.kill(workers[0], signal.SIGKILL)
    try:
        for batch in made:
            pass
    except ProjectError as error:
        print(error)
"""


@pytest.mark.slow
def test_workers_end_with_a_process_that_is_killed(tmp_path):
    (tmp_path / "parent.py").write_text(_PARENT + _WAITING)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py")],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    workers = [int(word) for word in parent.stdout.readline().split()]
    assert workers
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and any(_runs(worker) for worker in workers):
        time.sleep(0.1)
    assert not any(_runs(worker) for worker in workers)


@pytest.mark.slow
def test_a_worker_that_dies_is_one_line(tmp_path):
    (tmp_path / "parent.py").write_text(_PARENT + _KILLING)
    (line,) = child(tmp_path / "parent.py").splitlines()
    assert "a process that makes samples has died" in line and "--resume" in line


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (ProcessLookupError, FileNotFoundError):
        return False
    return state != "Z"


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_why_a_sample_is_missing_arrives_in_one_line(workers):
    with pytest.raises(DegenerateError, match=r"^sample 0 cannot be drawn$"):
        next(batches(Refusing(), [range(2)], workers=workers))
