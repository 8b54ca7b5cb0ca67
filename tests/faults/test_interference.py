"""Two commands on one folder, a clock that jumps, a worker that dies, kills between two files."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import pytest
from kill_commands import PLAIN
from run_files import Killed, results

from gvtools.capture.project import replaced_folder
from gvtools.errors import ProjectError
from gvtools.runs.folder import folder_lock
from gvtools.scenes.colmap_model import CAMERAS
from pipelines.cli import main

RUN = (*PLAIN, "--quiet")


def test_a_second_training_of_a_folder_is_refused(tmp_path, capsys):
    words = ["train", "micro", "--stage", "encoder", "--device", "cpu", "--out", str(tmp_path)]
    with folder_lock(tmp_path):
        assert main([*words, "--quiet"]) == 2
    assert "another process is at work" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_second_capture_leaves_the_first_ones_work_alone(tmp_path):
    out = tmp_path / "project"
    with replaced_folder(out) as work:
        (work / "mine").write_text("half-done")
        with pytest.raises(ProjectError, match="another process"), replaced_folder(out):
            raise AssertionError("not reached")
        assert (work / "mine").read_text() == "half-done"
    assert [path.name for path in tmp_path.iterdir()] == ["project"]
    assert (out / "mine").exists()


def test_what_a_kill_left_in_a_round_is_cleared(scan, run, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    left = copy / "round_000" / ".memory.tiles.part"
    left.mkdir()
    (left / "00001.000001.tile").write_bytes(b"of no use")
    assert main(["reconstruct", str(scan), "--out", str(copy), *RUN, "--resume"]) == 0
    assert not left.exists()
    assert results(copy) == results(run)


def test_what_a_killed_capture_left_is_cleared(tmp_path):
    left = tmp_path / ".project.part" / "mapping"
    left.mkdir(parents=True)
    (left / "database.db").write_bytes(b"half")
    with replaced_folder(tmp_path / "project") as work:
        assert list(work.iterdir()) == []
        (work / "new").touch()
    assert [path.name for path in (tmp_path / "project").iterdir()] == ["new"]


def test_a_clock_that_jumps_by_a_day_changes_nothing(scan, run, tmp_path, monkeypatch):
    """Back and forth: durations come from clocks that only go on, and no file is named by one."""
    real, calls = time.time, 0

    def jumping() -> float:
        nonlocal calls
        calls += 1
        return real() + 86_400 * (-1) ** calls

    monkeypatch.setattr(time, "time", jumping)
    out = tmp_path / "run"
    assert main(["reconstruct", str(scan), "--out", str(out), *RUN]) == 0
    time.time()
    assert calls
    assert results(out) == results(run)
    for line in (out / "rounds.jsonl").read_text().splitlines():
        seconds = json.loads(line)["seconds"]
        assert all(0 <= value < 600 for value in seconds.values()), seconds


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    out = tmp_path_factory.mktemp("exported") / "project"
    assert main(["export", str(run), "--format", "colmap", "--out", str(out), "--quiet"]) == 0
    return out


@pytest.mark.parametrize(
    "moment",
    [1, pytest.param(2, marks=pytest.mark.slow), 3, pytest.param(4, marks=pytest.mark.slow), 5],
)
def test_a_colmap_export_that_stops_at_any_rename_can_be_made_again(
    run, exported, tmp_path, monkeypatch, moment
):
    out, calls = shutil.copytree(exported, tmp_path / "project"), 0
    words = ["export", str(run), "--format", "colmap", "--out", str(out), "--quiet"]
    model = out / "sparse" / "0"
    whole = {path.name: path.read_bytes() for path in model.iterdir()}

    def stopping(rename):
        def stopped(*args):
            nonlocal calls
            calls += 1
            if calls == moment:
                raise Killed
            return rename(*args)

        return stopped

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", stopping(os.replace))
        with pytest.raises(Killed):
            main(words)
    # Either the earlier model as a whole, or none: never files of two.
    assert not (model / CAMERAS).exists() or moment == 1
    assert main(words) == 0
    assert {path.name: path.read_bytes() for path in model.iterdir()} == whole
