# mypy: no-check-untyped-defs
from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import geoverse_models as micro
import pytest
import torch
from published_folder import write_published
from torch import Tensor

from gvtools.completers.geoverse import GeoVerse, from_pretrained
from gvtools.completers.geoverse.config import GeoVerseConfig, named, read
from gvtools.completers.geoverse.flow import interpolate, velocity_from_clean, velocity_target
from gvtools.completers.geoverse.refiner import CompletedViews, RefinerConfig
from gvtools.completers.geoverse.video_prior import VideoFeatures
from gvtools.errors import OptionError
from gvtools.networks.config_json import to_json
from gvtools.networks.depth_anything.network import DepthAnything3
from gvtools.training.data import TrainingSamples
from gvtools.training.options import (
    SHIPPED,
    RefinerStageOptions,
    ReflowStageOptions,
    shipped_or_read,
)
from gvtools.training.samples import Draws, TrainingBatch
from gvtools.training.small_model_stages import CUT, RefinerStage, augment, view_errors
from gvtools.training.stages import ReflowStage
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def model() -> GeoVerse:
    torch.manual_seed(0)
    config, folder = shipped_or_read("micro")
    chosen = config.network(folder)
    # The last interval lies within the floor.
    flow = replace(chosen.flow, prediction="clean", least_time=0.2, level1=(1.0, 0.4, 0.1, 0.0))
    return GeoVerse(replace(chosen, flow=flow))


@pytest.mark.parametrize("time", [0.01, 0.1, 0.2, 0.7, 1.0])
def test_the_right_clean_prediction_has_no_error_at_any_time(model, time):
    clean, noise = torch.randn(2, 2, 3, 4, 5, 6)
    t = torch.tensor([time, 0.5])
    state = interpolate(clean, noise, t)
    least = model.config.flow.least_time
    given = velocity_from_clean(clean, state, t, least=least)
    wanted = model.velocity_wanted(velocity_target(clean, noise), t)
    torch.testing.assert_close(given, wanted, rtol=1e-4, atol=1e-4)
    plain = replace(
        model.config, flow=replace(model.config.flow, prediction="velocity", skip=False)
    )
    other = GeoVerse(plain)
    assert torch.equal(other.velocity_wanted(noise, t), noise)


def test_a_denoiser_that_is_right_has_nothing_to_distil(model, monkeypatch):
    """Its steps end in the clean latents, whatever the interval; noise left there is no teacher."""
    config, _ = shipped_or_read("micro")
    samples = TrainingSamples(config, model.config)
    batch = samples.batch(range(4))
    _, clean = model.clean_latents(batch.true_views)

    def right(self: GeoVerse, prepared: Any, state: Tensor, t: Tensor, **options: Any) -> Tensor:
        least = options.get("least") or self.config.flow.least_time
        # A gradient, as of a network.
        zero = 0 * next(self.level1.parameters()).sum()
        return velocity_from_clean(clean + zero, state, t, least=least)

    monkeypatch.setattr(GeoVerse, "velocity1", right)
    stage = ReflowStage(model, ReflowStageOptions(steps=4))
    for number in range(4):
        _, terms = stage(batch, Draws(0, "reflow", number, (0, 1, 2, 3)))
        assert float(terms["reflow"].detach()) < 1e-6 and float(terms["flow"].detach()) < 1e-6


@pytest.mark.parametrize("injection", ["control", "shared"])
def test_student_and_teacher_share_what_is_frozen_and_nothing_else(monkeypatch, injection):
    model = micro.model(micro.config(injection=injection))
    features, views = micro.video_features(1, 4), micro.batch()
    asked: list[str] = []

    class Prior:
        def features(self, *given: Any, **options: Any) -> VideoFeatures:
            asked.append("video")
            return features

    def encode(self: DepthAnything3, *given: Any, **options: Any) -> list[Tensor]:
        asked.append("encoder")
        return original(self, *given, **options)

    original = DepthAnything3.encode
    monkeypatch.setattr(DepthAnything3, "encode", encode)
    model.attach_video(Prior())
    model.prepare(views)
    once = sorted(asked)
    stage = ReflowStage(model, ReflowStageOptions(steps=2))
    teacher = stage._teacher[0]
    expected = teacher.prepare(views)
    own = model.control or model.shared
    assert own is not None
    with torch.no_grad():
        for parameter in own.parameters():
            parameter.add_(0.1)
    seen: dict[bool, Any] = {}
    velocity = GeoVerse.velocity1

    def spied(self: GeoVerse, prepared: Any, *given: Any, **options: Any) -> Tensor:
        seen[self is teacher] = prepared
        return velocity(self, prepared, *given, **options)

    monkeypatch.setattr(GeoVerse, "velocity1", spied)
    asked.clear()
    stage(TrainingBatch(views, views.images, views.depth), Draws(0, "reflow", 0, (0,)))
    # The truth is encoded once more; nothing else is.
    assert sorted(asked) == sorted([*once, "encoder"]) and once.count("video") == 1

    def entering(prepared: Any) -> list[Tensor]:
        return prepared.adapted or [keys.key for keys in prepared.keys.values()]

    both = zip(entering(seen[True]), entering(expected), entering(seen[False]), strict=True)
    for taught, as_before, student in both:
        assert torch.equal(taught, as_before) and not torch.equal(taught, student)


def draws(step: int = 0, samples: int = 2) -> Draws:
    return Draws(0, "refiner", step, tuple(range(samples)))


@pytest.mark.parametrize("step", range(6))
def test_views_and_truth_are_changed_alike(step):
    generator = torch.Generator().manual_seed(step)
    picture = torch.rand(4, 3, 32, 40, generator=generator)
    place = torch.arange(32.0 * 40).reshape(1, 1, 32, 40).expand(4, 1, 32, 40)
    views = CompletedViews(
        filled=picture,
        depth=place,
        valid=place % 2 == 0,
        evidence=place.expand(4, 2, 32, 40),
        made=picture,
        mean=picture[..., 3, 4],
    )
    found, truth, (where,) = augment(views, picture, [place], draws=draws(step))
    height, width = truth.shape[-2:]
    assert CUT * 32 - 1 <= height <= 32 and height % 2 == width % 2 == 0
    assert torch.equal(found.made, truth) and torch.equal(found.filled, truth)
    assert torch.equal(found.depth, where) and torch.equal(found.evidence[:, 1:], where)
    assert torch.equal(found.valid, where % 2 == 0)
    # Pixels keep their neighbours, and a sample's views are changed alike.
    step_right = (where[..., 1:] - where[..., :-1]).unique()
    assert step_right.numel() <= 2 and set(step_right.abs().tolist()) == {1.0}
    assert torch.equal(where[0], where[1]) and torch.equal(where[2], where[3])
    # The mean colour is changed as a pixel of that colour.
    at = (where[0, 0] == 3 * 40 + 4).nonzero()
    if len(at):
        row, column = at[0].tolist()
        assert torch.allclose(found.mean[0], truth[0, :, row, column])


def test_errors_are_of_holes_alone():
    truth = torch.zeros(2, 3, 4, 4)
    made, holes = truth.clone(), torch.zeros(2, 1, 4, 4, dtype=torch.bool)
    made[0, :, :2] = 0.5
    holes[0, :, 1:] = True
    error, count = view_errors(made, truth, holes)
    assert count.tolist() == [12, 0]
    torch.testing.assert_close(error, torch.tensor([0.25 * 4 / 12, 0.0]))


@pytest.fixture(scope="module")
def stage() -> RefinerStage:
    configuration = micro.config(
        hints={"fill": "surfaces"}, composition="correction", refiner=RefinerConfig(widths=(8, 16))
    )
    return RefinerStage(micro.model(configuration), RefinerStageOptions())


def training_batch() -> TrainingBatch:
    views = micro.batch(2)
    truth = torch.full_like(views.images, 0.4)
    views = replace(views, images=torch.where(views.valid, truth, 0.0))
    return TrainingBatch(views, truth, 2 + torch.rand_like(views.depth))


def test_it_completes_a_sample_once_and_learns_from_it(stage):
    batch = training_batch()
    calls = []
    made = stage._generate
    stage._generate = lambda views, names: calls.append(len(names)) or made(views, names)
    assert {name.split(".")[1] for name, p in stage.named_parameters() if p.requires_grad} == {
        "refiner"
    }
    learning = [p for p in stage.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(learning, 5e-3)
    values = []
    for step in range(12):
        loss, terms = stage(batch, draws(step))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        values.append(float(terms["gain"].detach()))
    assert calls == [2]
    # The truth is one colour, that of what is known: everything but the core's picture is right.
    assert values[-1] > max(values[0], 0) + 1


def test_what_is_kept_is_what_is_made(stage):
    batch = training_batch()
    stage._cache.clear()
    fresh = stage._completions(batch.views)
    kept = stage._completions(batch.views)
    turned = stage._completions(batch.views.samples(torch.tensor([1, 0])))
    for one, two, three in zip(fresh, kept, turned, strict=True):
        assert torch.equal(one, two) and torch.equal(one[[1, 0]], three)


def test_a_model_without_a_refiner_is_refused():
    configuration = micro.config(hints={"fill": "surfaces"}, composition="correction")
    with pytest.raises(OptionError, match="stage refiner: expected a model with refiner"):
        RefinerStage(micro.model(configuration), RefinerStageOptions())


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
