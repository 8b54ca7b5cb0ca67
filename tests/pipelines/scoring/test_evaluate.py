from __future__ import annotations

import json
import shutil
from collections.abc import Callable

import numpy as np
import pytest
from command_line import refused
from PIL import Image
from tiny_scan import write_scan

from gvtools.evaluation.images import FIGURES, psnr
from gvtools.runs.run import load_run
from gvtools.scenes.project import open_project
from pipelines.cli import main

RUN = ("--context", "first:3", "--views-per-round", "2", "--quiet",
       "--refine", "0", "--set", "refine.poses=false")  # fmt: skip


def reconstruct(scan, out, *more: object) -> None:
    assert main(["reconstruct", str(scan), "--out", str(out), *RUN, *map(str, more)]) == 0


@pytest.fixture(scope="module")
def measured(small_evaluation):
    return small_evaluation, json.loads((small_evaluation / "evaluation.json").read_text())


@pytest.fixture(scope="module")
def other(small_scan, tmp_path_factory):
    """Another run of the same project."""
    out = tmp_path_factory.mktemp("other") / "run"
    reconstruct(small_scan, out, "--targets", "range:3-4", "--seed", 4)
    return out


def test_the_figures_that_scripts_read_stand_at_the_top(measured, small_scan):
    _, figures = measured
    for name in ("psnr", "ssim", "lpips", "psnr_valid", "psnr_generated", "depth_rel_valid",
                 "depth_rel_generated", "coverage", "views", "seconds_per_view"):  # fmt: skip
        assert name in figures
    assert figures["views"] == 4
    assert figures["psnr_valid"] > 20
    assert figures["depth_rel_valid"] < 1e-3
    assert figures["lpips"] is None
    assert "vgg16-397923af.pth" in figures["notes"]["lpips"]
    run, names = figures["runs"][0], open_project(small_scan).names
    assert run["split"]["context"] == list(names[:3])
    assert run["split"]["rounds"] == [list(names[4:6]), list(names[6:])]
    assert run["versions"]["gvtools"] and run["settings"]["completer"] == "inpaint"


def test_figures_are_of_the_runs_pictures_by_region(measured, small_run):
    _, figures = measured
    views = {view["name"]: view for view in figures["runs"][0]["images"]["views"]}
    for completed, target, truth in load_run(small_run).targets():
        assert truth is not None
        reference = truth.load().rgb
        view = views[target.name]
        assert view["round"] == completed.round
        assert view["psnr"] == pytest.approx(psnr(target.picture, reference))
        expected = psnr(target.picture, reference, mask=target.observed)
        assert view["psnr_valid"] == pytest.approx(expected)
        expected = psnr(target.picture, reference, mask=target.generated)
        assert view["psnr_generated"] == (None if expected is None else pytest.approx(expected))
        assert not (target.observed & target.generated).any()
        assert view["observed"] == pytest.approx(completed.report["observed"])


def test_means_are_over_views_and_rounds_with_intervals(measured):
    _, figures = measured
    images = figures["runs"][0]["images"]
    values = [view["psnr"] for view in images["views"]]
    mean = images["mean"]["psnr"]
    assert mean["mean"] == pytest.approx(np.mean(values))
    assert min(values) <= mean["low"] <= mean["mean"] <= mean["high"] <= max(values)
    assert mean["n"] == 4
    assert [part["round"] for part in images["rounds"]] == [1, 2]
    assert images["rounds"][1]["psnr"]["mean"] == pytest.approx(np.mean(values[2:]))
    assert set(images["mean"]) == set(FIGURES)


def test_consistency_and_poses_have_a_status_and_the_true_pictures_beside(measured):
    _, figures = measured
    run = figures["runs"][0]
    for kind in ("generated", "true_pictures"):
        part = run["consistency"][kind]
        assert part["depth_reprojection"]["mean_relative_depth"] < 0.01
        assert len(part["depth_reprojection"]["pairs"]) == 3
        assert "status" in part["geometric_verification"]
        score = part["feature_consistency"]
        assert score["score"]["mean"] < score["unrelated"]
        assert part["met3r"]["score"]["mean"] is None
        assert "met3r" in part["met3r"]["status"]
    poses = run["poses"]
    if poses["status"] == "measured":
        assert poses["pictures"] == 4
        assert len(poses["failures"]) == 4 - poses["located"]


def test_every_table_is_there_in_every_form(measured):
    out, _ = measured
    for table in ("summary", "views", "published_dl3dv", "published_scannetv2"):
        for suffix in (".csv", ".md", ".tex"):
            assert (out / f"{table}{suffix}").stat().st_size > 100
    rows = (out / "published_dl3dv.csv").read_text().splitlines()
    assert sum("published" in row for row in rows) == 8
    ours = next(row for row in rows if "measured here" in row)
    assert ours.startswith("gvtools")
    assert "data set: a scene of one's own" in (out / "published_dl3dv.md").read_text()


def test_targets_without_truth_have_no_image_figures(small_scan, tmp_path):
    reconstruct(small_scan, tmp_path / "run", "--targets", "interpolate:2")
    assert main(["evaluate", str(tmp_path / "run"), "--quiet", "--parts", "images"]) == 0
    figures = json.loads((tmp_path / "run/evaluation/evaluation.json").read_text())
    assert figures["psnr"] is None
    assert figures["notes"]["psnr"] == "no target has a true picture"
    assert figures["views"] == 2


def test_several_runs_are_scenes(small_run, other, tmp_path):
    out = tmp_path / "both"
    words = ["evaluate", str(small_run), str(other), "--out", str(out), "--parts", "images"]
    assert main([*words, "--quiet"]) == 0
    figures = json.loads((out / "evaluation.json").read_text())
    means = [run["images"]["mean"]["psnr"]["mean"] for run in figures["runs"]]
    assert figures["psnr"] == pytest.approx(np.mean(means))
    assert figures["over_scenes"]["psnr"]["n"] == figures["scenes"] == 2
    assert (out / "views_001.csv").is_file()


@pytest.mark.slow
def test_the_protocol_splits_runs_and_measures(small_scan, tmp_path):
    out = tmp_path / "out"
    words = ["evaluate", str(small_scan), "--protocol", "pass", "--out", str(out), "--quiet"]
    assert main([*words, "--parts", "images", "--completer", "none"]) == 0
    split = json.loads((out / "split.json").read_text())
    assert len(split["context"]) == 2
    assert [len(names) for names in split["rounds"]] == [6]
    figures = json.loads((out / "evaluation.json").read_text())
    assert figures["runs"][0]["split"]["rounds"] == split["rounds"]
    # Once more: the run is there, and is measured again.
    assert main([*words, "--parts", "images", "--completer", "none"]) == 0


def test_wrong_input_ends_in_one_line(small_run, small_scan, tmp_path, capsys):
    assert "run.json" in refused(capsys, "evaluate", small_scan)
    assert "--parts" in refused(capsys, "evaluate", small_run, "--parts", "images,speed")
    assert "--out" in refused(capsys, "evaluate", small_run, small_run)
    assert "did you mean" in refused(capsys, "evaluate", small_run, "--against", "scannet")
    assert "--protocol" in refused(capsys, "evaluate", small_run, "--stride", 2)
    assert "--out" in refused(capsys, "evaluate", small_scan, "--protocol", "long")
    line = refused(capsys, "evaluate", small_run, "--lpips-weights", tmp_path)
    assert "vgg16-397923af.pth is absent" in line
    wide = refused(capsys, "evaluate", small_scan, "--protocol", "long", "--out", tmp_path / "long")
    assert "expected at least 20" in wide
    assert "at least 0" in refused(capsys, "evaluate", small_run, "--seed", -1)
    out = ("--out", tmp_path / "long")
    assert "given twice" in refused(capsys, "evaluate", small_run, small_run, *out)
    decided = ("--protocol", "pass", "--set", "rounds=1", *out)
    assert "decided by --protocol" in refused(capsys, "evaluate", small_scan, *decided)
    assert not (small_run / "evaluation").exists()


def test_a_project_that_changed_or_went_is_said(small_scan, tmp_path, capsys):
    copy = tmp_path / "scan"
    shutil.copytree(small_scan, copy)
    reconstruct(copy, tmp_path / "run", "--targets", "range:3-4")
    pose = copy / "frame-000003.pose.txt"
    text = pose.read_text()
    matrix = np.loadtxt(pose)
    matrix[0, 3] += 0.1
    np.savetxt(pose, matrix)
    assert "another one now" in refused(capsys, "evaluate", tmp_path / "run", "--quiet")
    pose.write_text(text)
    copy.rename(tmp_path / "moved")
    assert "no such folder" in refused(capsys, "evaluate", tmp_path / "run", "--quiet")
    words = ["evaluate", str(tmp_path / "run"), "--project", str(tmp_path / "moved"), "--quiet"]
    assert main([*words, "--parts", "images"]) == 0
    assert "not those" not in capsys.readouterr().err
    picture = tmp_path / "moved" / "frame-000003.color.png"
    Image.fromarray(np.asarray(Image.open(picture))[::-1]).save(picture)
    assert main([*words, "--parts", "images"]) == 0
    assert "1 of 2 target photographs are not those" in capsys.readouterr().err


def test_what_is_beside_published_rows_says_what_it_stands_on(tmp_path):
    """Masked pictures, few located views and one project twice are no ranking on a data set."""
    masked = write_scan(tmp_path / "masked", views=5)
    for path in masked.glob("*.color.png"):
        with Image.open(path) as image:
            rgba = image.convert("RGBA")
        rgba.putalpha(Image.fromarray((np.arange(96)[None] > 20).repeat(72, 0).astype("u1") * 255))
        rgba.save(path)
    runs = [tmp_path / "a" / "run", tmp_path / "b" / "run"]
    reconstruct(masked, runs[0], "--targets", "range:3-4")
    shutil.copytree(*runs)
    out = tmp_path / "out"
    words = ["evaluate", *map(str, runs), "--out", str(out), "--data-set", "dl3dv", "--seed", "7"]
    assert main([*words, "--against", "dl3dv", "--quiet"]) == 0
    text = (out / "published_dl3dv.md").read_text()
    assert "compared pixels: inside masks here" in text
    assert "scenes: a single one here" in text
    figures = json.loads((out / "evaluation.json").read_text())
    assert [run["name"] for run in figures["runs"]] == ["a/run", "b/run"]
    assert figures["evaluation"]["seed"] == 7
    assert figures["evaluation"]["bootstrap"] == {"level": 0.95, "resamples": 2000}
    assert figures["protocol_row"]["probed"] == 4
    assert figures["runs"][0]["images"]["settings"]["masked_share"] == pytest.approx(21 / 96)
    summary = (out / "summary.csv").read_text()
    assert "all scenes,psnr" in summary


def test_damage_ends_in_one_line(small_run, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(small_run, run)

    def damaged(name: str, change: Callable[[dict], object]) -> str:
        before = (run / name).read_text()
        data = json.loads(before)
        change(data)
        (run / name).write_text(json.dumps(data))
        line = refused(capsys, "evaluate", run, "--quiet")
        (run / name).write_text(before)
        return line

    assert "schedule" in damaged("run.json", lambda record: record.pop("schedule"))
    report = "round_002/report.json"
    line = damaged(report, lambda data: data["views"][0].pop("coverage"))
    assert "no report of this version" in line
    for folder in run.glob("round_00[12]"):
        shutil.rmtree(folder)
    assert "no round of targets" in refused(capsys, "evaluate", run)
