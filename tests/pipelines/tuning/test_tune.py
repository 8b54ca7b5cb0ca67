from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import refused
from micro_weights import write_micro_weights
from PIL import Image
from tiny_scan import ExactDepth, write_colmap_scan, write_scan

from gvtools.completers import Completer, Completion
from gvtools.completers.base import create
from gvtools.completers.geoverse import from_pretrained
from gvtools.completers.geoverse.config import read
from gvtools.depth import choice
from gvtools.errors import ProjectError
from gvtools.scenes.project import open_project
from gvtools.training.options import SHIPPED
from pipelines.cli import main
from pipelines.reconstruction import prepare
from pipelines.tuning import tune as tuning
from pipelines.tuning.tune import generated_psnr, split_context

pytestmark = pytest.mark.usefixtures("one_thread")

MICRO = read(SHIPPED / "micro_model.json")


@pytest.fixture(scope="module", autouse=True)
def twice() -> Iterator[None]:
    """It is judged twice, and poses, which are exact, are not refined."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning, "JUDGEMENTS", 2)
        patch.setattr(prepare, "refined_poses_of", lambda *given, **options: None)
        yield


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    return write_scan(tmp_path_factory.mktemp("scan"), views=10)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    return write_micro_weights(tmp_path_factory.mktemp("micro"))


@pytest.fixture(scope="module")
def split(scan):
    return split_context(open_project(scan), MICRO)


def tune(scan: Path, weights: Path, out: Path, *more: object) -> int:
    words = ["train", "tune", "--scene", scan, "--init", weights, "--out", out, "--device", "cpu"]
    return main([str(word) for word in (*words, *more)])


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    return from_pretrained(folder).state_dict()


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a | b)


def test_a_judging_view_is_never_learnt_from(split):
    judges, learnt = set(split.judged.targets), set()
    assert len(split.views) == 10 and len(judges) == 2
    for index in range(24):
        learnt |= {*split.learnt.chosen(index), *split.learnt.lifted(index)}
    assert learnt == set(range(10)) - judges
    for case in split.predictions():
        assert {view.name for view in case.context}.isdisjoint(split.judges)
        assert case.guidance.cameras.names[0] in split.judges


def test_samples_follow_from_their_number_and_hold_their_target_out(split, scan):
    again = split_context(open_project(scan), MICRO)
    known = []
    for index in range(8):
        one, two = split.learnt.sample(index), again.learnt.sample(index)
        assert torch.equal(one.hint, two.hint) and torch.equal(one.images, two.images)
        *given, target = split.learnt.chosen(index)
        assert target not in (*given, *split.learnt.lifted(index))
        assert (
            not set(given) & set(split.learnt.lifted(index))
            and len(one.images) == len(given) + 1 == one.context + 1
        )
        assert one.images.shape[2:] == (36, 48)
        rgb = split.views[target].truth.rgb[0].transpose(2, 0, 1) / 255
        np.testing.assert_allclose(one.images[-1], rgb, atol=1e-6)
        known.append(float(one.valid[-1].float().mean()))
    # Memory of few views has holes.
    assert min(known) > 0 and np.mean(known) < 0.95


def test_what_is_predicted_is_the_memory_of_the_given_views(split):
    for case in split.predictions():
        known = case.guidance.valid
        assert 0 < known.mean() < 0.99
        error = np.abs(case.guidance.rgb - case.rgb)[known]
        assert np.median(error) < 0.05


def test_the_judges_figure_counts_generated_pixels_alone(split):
    class Off(Completer):
        """The truth, off by a known error in the holes and by another elsewhere."""

        name = "off"

        def complete(self, context, guidance, *, seed=0):
            rgb = np.where(guidance.valid[..., None], 0.0, cases[seed].rgb + 0.1)
            rgb = np.where(rgb > 1, cases[seed].rgb - 0.1, rgb).astype(np.float32)
            return Completion(rgb, guidance.depth, guidance.confidence.clip(0, 1))

    cases = split.predictions()
    assert generated_psnr(Off(), cases) == pytest.approx(20, abs=0.01)


def test_views_that_leave_nothing_to_generate_are_refused(split):
    case = split.predictions()[0]
    whole = replace(case.guidance, valid=np.ones_like(case.guidance.valid))
    with pytest.raises(ProjectError, match="show each other whole"):
        generated_psnr(create("none"), [replace(case, guidance=whole)])


def test_a_number_of_steps_gives_the_same_weights_and_no_other_view_is_read(
    scan, weights, tmp_path, monkeypatch
):
    # Better at every look, so that the last weights are written.
    figures = iter(np.arange(100.0))
    monkeypatch.setattr(tuning, "generated_psnr", lambda *_: float(next(figures)))
    more = ("--steps", 2, "--context", "every:2", "--quiet")
    first, second = tmp_path / "first", tmp_path / "second"
    assert tune(scan, weights, first, *more) == 0
    changed = tmp_path / "changed"
    shutil.copytree(scan, changed)
    for index in range(1, 10, 2):
        path = changed / f"frame-{index:06d}.color.png"
        Image.fromarray(np.zeros((72, 96, 3), np.uint8)).save(path)
    assert tune(changed, weights, second, *more) == 0
    found, before = tensors(first), tensors(weights)
    assert same(found, tensors(second)) and not same(found, before)
    # Denoisers learn, the encoder and the heads do not.
    moved = {name.split(".")[0] for name in found if not torch.equal(found[name], before[name])}
    assert moved <= {"level1", "cascade"} and "level1" in moved
    assert from_pretrained(first).config == from_pretrained(weights).config


def test_the_best_of_all_looks_is_kept_and_said(scan, weights, tmp_path, capsys):
    out, figures = tmp_path / "out", tmp_path / "figures.json"
    assert tune(scan, weights, out, "--steps", 4, "--json", figures) == 0
    found = json.loads(figures.read_text())
    said = capsys.readouterr().out
    assert found["steps"] == 4 and found["kept"] == (found["psnr_after"] > found["psnr_before"])
    assert f"{found['psnr_before']:.2f} dB untuned" in said
    assert said.count("tune: step ") == tuning.JUDGEMENTS
    record = json.loads((out / "tuning.json").read_text())
    assert {name: record[name] for name in found} == found


def test_worse_weights_are_not_kept(scan, weights, tmp_path, monkeypatch, capsys):
    figures = iter([20.0, 19.0, 18.0])
    monkeypatch.setattr(tuning, "generated_psnr", lambda *_: next(figures))
    out = tmp_path / "out"
    assert tune(scan, weights, out, "--steps", 2) == 0
    assert same(tensors(out), tensors(weights))
    said = capsys.readouterr().out
    assert "the weights stay as they were" in said
    assert "20.00 dB untuned, 19.00 dB tuned" in said
    assert json.loads((out / "tuning.json").read_text())["kept"] is False


@pytest.mark.slow
def test_weights_are_trained_in_full_precision_whatever_the_run_completes_in(
    scan, weights, tmp_path
):
    kept = {}
    for precision in ("float32", "bfloat16"):
        out = tmp_path / precision
        options = tuning.TuneOptions(steps=2)
        tuning.tune(
            open_project(scan), weights, out, options=options, say=lambda text: None,
            completer={"precision": precision, "device": "cpu"},
        )  # fmt: skip
        kept[precision] = tensors(out)
        assert {value.dtype for value in kept[precision].values()} == {torch.float32}
    assert same(kept["float32"], kept["bfloat16"])


@pytest.mark.slow
def test_the_clock_ends_it(scan, weights, tmp_path):
    figures = tmp_path / "figures.json"
    out = tmp_path / "out"
    assert tune(scan, weights, out, "--minutes", "0.05", "--json", figures, "--quiet") == 0
    assert json.loads(figures.read_text())["steps"] >= 1


def test_photographs_are_tuned_to_by_computed_depth(weights, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(choice, "_stereo", lambda *_: ExactDepth())
    project = write_colmap_scan(tmp_path / "colmap", views=6)
    out = tmp_path / "out"
    assert tune(project, weights, out, "--steps", 1) == 0
    assert "depth exact (no context view has recorded depth" in capsys.readouterr().out
    assert json.loads((out / "tuning.json").read_text())["views"] == 5


def test_bad_input_is_one_line(scan, weights, tmp_path, capsys):
    def said(*more: object) -> str:
        out = tmp_path / "out"
        line = refused(capsys, "train", "tune", "--out", out, "--init", weights, *more)
        assert not (out / "geoverse.safetensors").exists()
        return line

    scene = ("--scene", scan, "--steps", 1)
    assert "needs --scene" in said()
    assert "expected at least 4" in said(*scene, "--context", "first:3")
    assert "nothing to do" in said("--scene", scan, "--minutes", "0")
    assert "expected one of them" in said(*scene, "--minutes", "1")
    assert "--resume: train tune does not look at it" in said(*scene, "--resume")
    untrained = write_micro_weights(tmp_path / "untrained", trained=False)
    assert "untrained" in said(*scene, "--init", untrained)
    (tmp_path / "out").mkdir(exist_ok=True)
    (tmp_path / "out" / "mine").write_text("")
    assert "holds something" in said(*scene)
    assert "belongs to 'gvtools train tune'" in refused(
        capsys, "train", "micro", "--out", tmp_path / "x", "--minutes", "1"
    )
