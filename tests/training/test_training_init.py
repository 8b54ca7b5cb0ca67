from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from published_folder import write_published

from gvtools.completers.geoverse import GeoVerse, from_pretrained
from gvtools.completers.geoverse.config import GeoVerseConfig, named, read
from gvtools.networks.config_json import to_json
from gvtools.training.options import SHIPPED
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("one_thread")

STAGES = ("encoder", "denoiser", "reflow")


def small_base() -> GeoVerseConfig:
    base, micro = named("base"), read(SHIPPED / "micro_model.json")
    return replace(
        base,
        image_size=micro.image_size,
        views=micro.views,
        context=micro.context,
        geometry=micro.geometry,
        rgb=micro.rgb,
        level1=micro.level1,
        cascade=micro.cascade,
        video=None,
        injection="none",
    )


def random_model(config: GeoVerseConfig) -> GeoVerse:
    torch.manual_seed(3)
    model = GeoVerse(config)
    for parameter in model.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.1)
    for statistics in model.level_statistics:
        statistics.mean.normal_()
        statistics.var.uniform_(0.5, 2)
    return model.eval()


@pytest.fixture(scope="module")
def gld() -> GeoVerse:
    config = small_base()
    return random_model(replace(config, level1=replace(config.level1, depth_condition=False)))


@pytest.fixture(scope="module")
def published(gld, tmp_path_factory) -> Path:
    folder = write_published(gld, tmp_path_factory.mktemp("gld"))
    (folder / "config.json").unlink()
    return folder


@pytest.fixture(scope="module")
def training(tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("config")
    (folder / "model.json").write_text(json.dumps(to_json(small_base())))
    data = json.loads((SHIPPED / "micro.json").read_text())
    for stage in STAGES:
        data[stage]["optimizer"]["steps"] = 1
    # As ``base``: a model without a refiner.
    del data["refiner"]
    (folder / "training.json").write_text(json.dumps({**data, "model": "model.json"}))
    return str(folder / "training.json")


def train(training: str, out: Path, stage: str, *more: str) -> int:
    options = ["--device", "cpu", "--sheets", "0"]
    return main(["train", training, "--stage", stage, "--out", str(out), *options, *more])


def test_a_training_that_learns_nothing_leaves_what_gld_is(gld, published, training, tmp_path):
    """Every batch is skipped, so that the weights written are those of the start."""
    nothing = ["--set", "denoiser.optimizer.largest_loss=1e-9"]
    init = ["--init", str(published)]
    assert train(training, tmp_path, "denoiser", *init, *nothing) == 0
    start = from_pretrained(tmp_path / "denoiser" / "weights")
    known = gld.state_dict()
    for name, tensor in start.state_dict().items():
        if name.startswith("level1.depth_embedder."):
            assert not tensor.any(), name
        else:
            assert torch.equal(tensor, known[name]), name


@pytest.mark.slow
def test_a_training_goes_on_from_gld_without_the_encoders_stage(
    published, training, tmp_path, capsys
):
    assert train(training, tmp_path, "all", "--init", str(published)) == 0
    said = capsys.readouterr().out
    assert not (tmp_path / "encoder").exists()
    assert f"denoiser: starts from {published}" in said
    # Not from where the stage before had started.
    assert f"reflow: starts from {tmp_path / 'denoiser' / 'weights'}" in said
    trained = from_pretrained(tmp_path / "denoiser" / "weights")
    assert trained.config.trained
    assert trained.level1.depth_embedder.proj.weight.any()


def test_a_training_goes_on_from_the_published_files_that_it_began_with(
    published, training, tmp_path, capsys
):
    other = tmp_path / "other"
    shutil.copytree(published, other)
    [changed] = (other / "checkpoints").glob("da3_level1.pt")
    values = bytearray(changed.read_bytes())
    values[len(values) // 2] ^= 1
    changed.write_bytes(values)
    init = ["--init", str(published)]
    assert train(training, tmp_path / "out", "denoiser", *init, "--until", "1") == 0
    again = ["--init", str(other), "--resume"]
    assert train(training, tmp_path / "out", "denoiser", *again) == 2
    assert "start" in capsys.readouterr().err


def test_other_starts_are_one_clear_line(published, training, tmp_path, capsys):
    part = tmp_path / "part"
    (part / "checkpoints").mkdir(parents=True)
    (part / "checkpoints" / "da3_level1.pt").symlink_to(published / "checkpoints/da3_level1.pt")
    for folder, expected in (
        (tmp_path / "absent", "absent does not exist"),
        (part, "pretrained_models/da3/model.safetensors"),
    ):
        assert train(training, tmp_path / "out", "denoiser", "--init", str(folder)) == 2
        said = capsys.readouterr().err
        assert expected in said
        assert said.count("\n") == 1
    # The files of a model of other sizes.
    assert main(["train", "tiny", "--out", str(tmp_path / "out"), "--init", str(published)]) == 2
    assert "expected" in capsys.readouterr().err
