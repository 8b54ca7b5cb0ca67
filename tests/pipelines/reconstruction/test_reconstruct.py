"""Runs round by round: what they leave, resumed after any stop, and by the paper's protocol."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
from itertools import count
from pathlib import Path

import pytest
from run_files import Killed, reconstructed, report_of, results, untimed
from tiny_scan import write_scan

from gvtools.errors import OptionError, ProjectError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.settings import dotted, with_values
from pipelines.cli import main
from pipelines.reconstruction.settings import PAPER, RunSettings

SETTINGS = ("context=first:2", "targets=range:2-5", "views_per_round=2", "completer=inpaint")


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("scan"))


@pytest.fixture(scope="module")
def whole(scan, tmp_path_factory):
    """An uninterrupted run."""
    return run(scan, tmp_path_factory.mktemp("runs") / "whole")


def run(scan: Path, out: Path, *settings: str, **how: bool) -> Path:
    return reconstructed(scan, out, "refine.steps=0", *SETTINGS, *settings, **how)


def test_the_memory_grows_round_by_round(whole):
    rounds = [json.loads(line) for line in (whole / "rounds.jsonl").read_text().splitlines()]
    assert [entry["round"] for entry in rounds] == [0, 1, 2]
    assert rounds[0]["generated"] == 0
    assert rounds[0]["observed"] == rounds[1]["observed"] == rounds[2]["observed"]
    assert rounds[2]["generated"] > rounds[1]["generated"] > 0
    for entry in rounds[1:]:
        assert entry["coverage_after"] > entry["coverage_before"]
        assert set(entry["seconds"]) >= {"depth", "fuse", "project", "complete", "align"}
    memory = SpatialMemory.load(whole / "memory.npz")
    assert len(memory) == rounds[-1]["points"]
    assert memory.voxels == rounds[-1]["voxels"]
    assert memory.nbytes == rounds[-1]["bytes"]


def test_the_figures_agree_with_the_scene(whole):
    metrics = json.loads((whole / "metrics.json").read_text())
    # The scene is smooth and its depth is rounded to millimetres.
    assert metrics["depth_rel_valid"] < 1e-3
    assert metrics["psnr_valid"] > 24
    assert metrics["lpips"] is None
    assert metrics["coverage_after"] > metrics["coverage"]


@pytest.mark.parametrize("moment", range(6, 40, 9))
def test_resuming_after_a_stop_gives_the_bytes_of_an_uninterrupted_run(
    whole, scan, tmp_path, monkeypatch, moment
):
    """Stop at some of the moments at which a file or folder takes its final name."""
    out, calls = tmp_path / "run", count()

    def stopping(rename):
        def stopped(*args, **kwargs):
            if next(calls) == moment:
                raise Killed
            return rename(*args, **kwargs)

        return stopped

    monkeypatch.setattr(os, "replace", stopping(os.replace))
    monkeypatch.setattr(Path, "replace", stopping(Path.replace))
    with contextlib.suppress(Killed):
        run(scan, out)
    monkeypatch.undo()
    run(scan, out, resume=True)
    assert results(out) == results(whole)
    assert untimed(out) == untimed(whole)


def test_resuming_a_finished_run_changes_nothing(whole):
    before = results(whole)
    scan = Path(json.loads((whole / "run.json").read_text())["project"])
    run(scan, whole, resume=True)
    assert results(whole) == before


def test_a_folder_of_another_run_is_refused_untouched(whole, scan):
    before = results(whole)
    with pytest.raises(ProjectError, match="another run"):
        run(scan, whole, "seed=5", resume=True)
    with pytest.raises(ProjectError, match="--resume"):
        run(scan, whole)
    assert results(whole) == before


def test_a_folder_that_is_no_run_is_refused_untouched(scan, tmp_path):
    (tmp_path / "letters.txt").write_text("mine")
    with pytest.raises(ProjectError, match=r"no run\.json"):
        run(scan, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["letters.txt"]


def test_a_dry_run_writes_nothing(scan, tmp_path):
    run(scan, tmp_path / "dry", dry_run=True)
    assert not (tmp_path / "dry").exists()


def test_a_disk_that_fills_up_leaves_the_rounds_before(whole, scan, tmp_path, monkeypatch):
    out = tmp_path / "run"
    save = SpatialMemory.save

    def full(self, path):
        if "round_002" in str(path):
            Path(path).write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(self, path)

    monkeypatch.setattr(SpatialMemory, "save", full)
    with pytest.raises(ProjectError, match=r"No space left.*--resume"):
        run(scan, out)
    monkeypatch.undo()
    assert len((out / "rounds.jsonl").read_text().splitlines()) == 2
    assert not list(out.glob(".round_*"))
    assert len(SpatialMemory.load(out / "round_001" / "memory.npz")) > 0
    run(scan, out, resume=True)
    assert results(out) == results(whole)


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ("completer=inpant", "inpaint"),
        ("depth=colmap", "rgbd"),
        ("depth=guess", "sensor"),
        ("targets=first:1", "allow-overlap"),
        ("completer.sweps=1", "sweeps"),
        ("memory.merge_angle_deg=-2", "at least 0 and at most 180"),
    ],
)
def test_wrong_options_leave_no_folder(scan, tmp_path, setting, text):
    with pytest.raises(OptionError, match=text):
        run(scan, tmp_path / "run", setting)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("profile", RunSettings.presets["profile"])
def test_every_setting_of_the_protocol_holds_with_every_profile(profile):
    for names in (("profile", "protocol"), ("protocol", "profile")):
        values = {"profile": profile, "protocol": "paper"}
        config = with_values(RunSettings(), {name: values[name] for name in names})
        assert config.protocol == "paper" and not config.refine.wanted
        found = dotted(config.to_dict())
        for key, value in PAPER.items():
            assert found[key.replace("completer.", "completer_options.")] == value, key


def test_every_setting_of_the_protocol_is_in_the_papers_table_and_no_other():
    page = Path(__file__).parents[3] / "docs" / "concepts" / "protocol.md"
    table = page.read_text(encoding="utf-8").split("| switch | in the paper |")[1].split("\n\n")[0]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]
    stated: list[str] = []
    for *_, switches, place in rows:
        stated += re.findall(r"`([\w.]+=[^`]+)`", switches)
        assert place.startswith(("Sec. ", "App. ", "Eq. ", "not stated")), place
    texts = {
        f"{key}={'none' if value is None else str(value).lower()}" for key, value in PAPER.items()
    }
    assert set(stated) == texts and len(stated) == len(texts)
    # How a model samples is its own: 49 guided steps of gld, a student's own bounds.
    for own in ("steps", "cascade_steps", "cfg_scale", "cascade_cfg_scale"):
        assert f"completer.{own}" not in PAPER


def test_a_setting_of_ones_own_stands_above_the_protocol():
    config = with_values(RunSettings(), {"fusion.pixels": "holes", "protocol": "paper"})
    assert config.fusion.pixels == "holes" and config.fusion.generated_as_observed


@pytest.mark.usefixtures("one_thread")
def test_a_run_by_it_shows_whole_views_and_resumes(tmp_path, capsys):
    scan = write_scan(tmp_path / "scan", views=8)
    words = ["reconstruct", str(scan), "--protocol", "paper", "--quiet", "--views-per-round", "1",
             "--set", "refine.poses=false"]  # fmt: skip
    words += ["--context", "first:6", "--targets", "range:6-7", "--out", str(tmp_path / "run")]
    assert main([*words, "--completer", "inpaint"]) == 2
    said = capsys.readouterr().err
    assert "protocol paper with completer 'inpaint'; expected geoverse" in said
    assert not (tmp_path / "run").exists()
    assert main([*words, "--rounds", "1"]) == 0
    report = report_of(tmp_path / "run", 1)
    (view,) = report["views"]
    # Pixels with depth are fused wherever they are, those that the memory knew, too.
    pixels = view["camera"]["width"] * view["camera"]["height"]
    assert view["fused_pixels"] > (1.3 - view["observed"]) * pixels
    assert report["generated"] == 0 and report["added"] > 0
    settings = json.loads((tmp_path / "run" / "run.json").read_text())["settings"]
    assert settings["protocol"] == "paper" and settings["completer"] == "geoverse"
    before = untimed(tmp_path / "run")
    assert main([*words, "--rounds", "1", "--resume"]) == 0
    assert untimed(tmp_path / "run") == before
