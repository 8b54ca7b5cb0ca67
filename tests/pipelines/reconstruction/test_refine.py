from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from run_files import reconstructed, results
from tiny_scan import write_scan

from gvtools.appearance import fit_options
from gvtools.files import write_json
from gvtools.runs.poses import RunPoses
from gvtools.runs.run import load_run
from pipelines.cli import main
from pipelines.console import Console
from pipelines.reconstruction import fitting
from pipelines.reconstruction import run as module
from pipelines.reconstruction.fitting import Fitted
from pipelines.reconstruction.run import refine

pytestmark = pytest.mark.usefixtures("unpainted")

SETTINGS = ("context=first:8", "targets=range:8-8", "views_per_round=1", "completer=inpaint")
QUIET = Console(quiet=True)
APPEARANCE = "round_000/appearance.npz"


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("scan"), views=9)


@pytest.fixture(scope="module")
def whole(scan, tmp_path_factory):
    return run(scan, tmp_path_factory.mktemp("runs") / "whole", "refine.steps=12")


@pytest.fixture
def copy(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "run"))


def refining_poses(copy: Path) -> dict:
    """Let the fit refine poses, too; the run's record."""
    record = json.loads((copy / "run.json").read_text())
    record["settings"]["refine"]["poses"] = True
    # As of a version that did not have them.
    record["settings"].pop("lens")
    write_json(copy / "run.json", record)
    return record


def run(scan: Path, out: Path, *settings: str, resume: bool = False) -> Path:
    return reconstructed(scan, out, *SETTINGS, *settings, resume=resume)


def test_the_fit_goes_on_where_it_ended(copy):
    before = Fitted.load(copy / APPEARANCE)
    refine(copy, steps=1, console=QUIET)
    after = Fitted.load(copy / APPEARANCE)
    change = np.abs(after.appearance.gaussians.values - before.appearance.gaussians.values)
    assert change.max() > 0
    # The step lengths of the last part of a fit: below 0.025 px at 0.02 scene units, then RATES.
    assert change[:, :3].max() < 0.025 * 0.04
    assert change[:, 3:].max() < 0.06
    was, now = (one.appearance.exposures for one in (before, after))
    assert was is not None and now is not None
    assert np.abs(was.log_gains).max() > 0
    assert np.abs(now.log_gains - was.log_gains).max() < 0.009
    assert after.appearance.blend == before.appearance.blend
    assert json.loads((copy / "run.json").read_text())["refined"] == [{"steps": 1}]


def test_refined_poses_go_on_from_the_saved_ones(copy):
    saved = Fitted.load(copy / APPEARANCE)
    scene, record = load_run(copy).scenes[0], refining_poses(copy)
    shifted = scene.subset(record["context"]).cameras.cam_from_world.copy()
    shifted[1, :3, 3] += [0.004, 0, 0]
    target = scene.subset(record["targets"]).cameras.cam_from_world
    Fitted(saved.appearance, RunPoses(shifted, target)).save(copy / APPEARANCE)
    refine(copy, steps=2, console=QUIET)
    after = Fitted.load(copy / APPEARANCE)
    # Two steps neither find the way back nor predict neighbours better: the saved ones are kept.
    assert after.poses is not None
    np.testing.assert_array_equal(after.poses.context, shifted)
    np.testing.assert_array_equal(after.poses.targets, target)


def test_photographs_are_shown_better_afterwards_by_a_moved_project(scan, copy, tmp_path, capsys):
    def error() -> float:
        appearance = Fitted.load(copy / APPEARANCE).appearance
        scene = load_run(copy).scenes[0]
        views = [scene[name] for name in load_run(copy).context]
        off = [appearance.picture(v.camera).rgb - v.load().rgb / 255.0 for v in views]
        return float(np.mean(np.square(off)))

    before = error()
    moved = Path(shutil.copytree(scan, tmp_path / "moved"))
    refine(copy, steps=30, project=moved, console=Console())
    assert "PSNR" in capsys.readouterr().out
    assert error() < 0.8 * before
    assert json.loads((copy / "run.json").read_text())["project"] == str(moved)


def test_the_same_steps_give_the_same_bytes(whole, tmp_path):
    runs = [Path(shutil.copytree(whole, tmp_path / name / "run")) for name in "ab"]
    for path in runs:
        refine(path, steps=2, console=QUIET)
    assert results(runs[0]) == results(runs[1])
    assert results(runs[0]).keys() == results(whole).keys()


def test_a_stop_at_any_moment_leaves_the_run_as_it_was(copy, monkeypatch):
    before = results(copy)

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    names = ("fit_appearance", "complete_run", "_figures", "rename")
    for place, name in zip((module, module, module, os), names, strict=True):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(place, name, stop)
            refine(copy, steps=1, console=QUIET)
        assert results(copy) == before, name
        assert os.listdir(copy.parent) == ["run"], name


def test_a_run_without_a_fit_gets_one_and_is_resumed_with_it(scan, tmp_path):
    settings = ("refine.steps=0", "refine.poses=true")
    out = run(scan, tmp_path / "run", *settings)
    assert not (out / APPEARANCE).exists()
    refine(out, steps=2, console=QUIET)
    refined = results(out)
    assert APPEARANCE in refined
    run(scan, out, *settings, resume=True)
    assert results(out) == refined


def test_an_interrupted_run_is_finished_and_files_of_the_user_are_kept_and_named(copy, capsys):
    shutil.rmtree(copy / "round_001")
    (copy / "metrics.json").unlink()
    (copy / "evaluation").mkdir()
    write_json(copy / "evaluation" / "evaluation.json", {})
    assert main(["refine", str(copy), "--steps", "2"]) == 0
    assert load_run(copy).complete
    assert (copy / "report.html").exists()
    assert "evaluation in" in capsys.readouterr().err
    assert (copy / "evaluation" / "evaluation.json").exists()


def test_what_cannot_be_refined_is_one_line_with_status_2(scan, copy, tmp_path, capsys):
    before = results(copy)
    assert "run.json" in refused(capsys, "refine", tmp_path)
    assert "run.json" in refused(capsys, "refine", tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    assert "at least 1" in refused(capsys, "refine", copy, "--steps", 0)
    assert "more than 0" in refused(capsys, "refine", copy, "--seconds", "nan")
    assert "not allowed with" in refused(capsys, "refine", copy, "--steps", 1, "--seconds", 1)
    assert "gone" in refused(capsys, "refine", copy, "--project", tmp_path / "moved")
    moved = Path(shutil.copytree(scan, tmp_path / "moved"))
    (moved / "frame-000001.color.png").touch()
    line = refused(capsys, "refine", copy, "--project", moved)
    assert "fingerprint" in line
    assert "project," not in line
    assert results(copy) == before


def test_a_converged_fit_is_joined_by_another_if_there_are_steps(copy, monkeypatch, capsys):
    monkeypatch.setattr(fit_options, "CONVERGED_PER_VIEW", 1)
    monkeypatch.setattr(fit_options, "CONVERGED_LEAST_RECORDED", 12)
    before = results(copy)
    line = refused(capsys, "refine", copy, "--steps", 5)
    assert "5 steps" in line and "expected 6" in line
    assert results(copy) == before
    earlier = Fitted.load(copy / APPEARANCE).appearance
    refine(copy, steps=6, console=QUIET)
    after = Fitted.load(copy / APPEARANCE).appearance
    assert len(after.fits) == 2
    np.testing.assert_array_equal(after.gaussians.values, earlier.gaussians.values)
    assert after.others[0].values.tobytes() != earlier.gaussians.values.tobytes()
    monkeypatch.setattr(fitting, "MOST_FITS", 2)
    assert "2 fits" in refused(capsys, "refine", copy, "--steps", 6)
