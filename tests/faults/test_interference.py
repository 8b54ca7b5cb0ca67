"""Two commands on one folder, a clock that jumps, a worker that dies, kills between two files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from kill_commands import PLAIN
from kill_contents import contents
from run_files import Killed, results

from gvtools.capture.project import replaced_folder
from gvtools.errors import ProjectError
from gvtools.runs.folder import folder_lock
from gvtools.scenes.colmap_model import CAMERAS
from gvtools.training.loop import StageState, TrainingProgress, load_state, save_state
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


@contextmanager
def mounted(folder: Path, options: str) -> Iterator[Path]:
    """A small disk in memory; the test is skipped where mounting is not allowed."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"no mount here: {error}")
    if done.returncode:
        pytest.skip(f"mounting is not allowed here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


def full(folder: Path, spare: int = 0) -> None:
    """Fill the disk but for so many bytes."""
    free = os.statvfs(folder)
    (folder / "filler").write_bytes(b"0" * max(0, free.f_bavail * free.f_frsize - spare))


def one_line(capsys: pytest.CaptureFixture[str], *parts: str) -> None:
    lines = [x for x in capsys.readouterr().err.splitlines() if not x.startswith("warning")]
    assert len(lines) == 1, lines
    assert lines[0].startswith("gvtools: ") and "unexpected" not in lines[0]
    assert any(part in lines[0] for part in parts), lines[0]


@pytest.mark.parametrize(
    "spare", [40_000, *(pytest.param(at, marks=pytest.mark.slow) for at in (0, 300_000))]
)
def test_a_run_on_a_full_disk_goes_on_when_there_is_room(scan, run, tmp_path, capsys, spare):
    with mounted(tmp_path / "disk", "size=4m") as disk:
        full(disk, spare)
        words = ["reconstruct", str(scan), "--out", str(disk / "run"), *RUN]
        assert main(words) == 2
        one_line(capsys, "No space left", "cannot be")
        (disk / "filler").unlink()
        assert main([*words, "--resume"]) == 0
        found, expected = contents(disk / "run"), contents(run)
        assert [n for n in found.keys() | expected.keys() if found.get(n) != expected.get(n)] == []


OUTPUTS = {
    "ply": ("export", "--format", "ply", "--out", "points.ply"),
    "colmap": ("export", "--format", "colmap", "--out", "project"),
    "transforms": ("export", "--format", "transforms", "--out", "transforms.json"),
    "glb": ("export", "--format", "glb", "--out", "points.glb"),
    "mp4": ("film", "--path", "interpolate:3", "--out", "film.mp4"),
    "gif": ("film", "--path", "interpolate:3", "--out", "film.gif"),
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_exports_and_films_on_a_full_disk_are_one_line(run, tmp_path, capsys, name):
    command, *words = OUTPUTS[name]
    with mounted(tmp_path / "disk", "size=8m") as disk:
        words = [*words[:-1], str(disk / words[-1])]
        full(disk)
        assert main([command, str(run), *words, "--quiet"]) == 2
        one_line(capsys, "No space left", "could not be written", "cannot be")
        left = [p for p in disk.rglob("*") if p.is_file() and p.stat().st_size]
        assert [path.name for path in left] == ["filler"]
        (disk / "filler").unlink()
        assert main([command, str(run), *words, "--quiet"]) == 0


def test_a_folder_that_cannot_be_written_is_one_line(scan, run, tmp_path, capsys):
    with mounted(tmp_path / "disk", "size=1m,ro") as disk:
        assert main(["reconstruct", str(scan), "--out", str(disk / "run"), *RUN]) == 2
        one_line(capsys, "Read-only")
        for command, *words in OUTPUTS.values():
            words = [*words[:-1], str(disk / words[-1])]
            assert main([command, str(run), *words, "--quiet"]) == 2
            one_line(capsys, "Read-only", "read-only")
        assert main(["capture", str(scan), "--out", str(disk / "project"), "--quiet"]) == 2
        words = ["data", "shards", str(scan), "--out", str(disk / "shards"), "--quiet"]
        capsys.readouterr()
        assert main(words) == 2
        one_line(capsys, "Read-only")


def state(value: float) -> StageState:
    return StageState(
        {"of": "a test"}, TrainingProgress(step=3), {"w": torch.full((60_000,), value)}
    )


def test_a_training_state_survives_a_full_disk(tmp_path):
    with mounted(tmp_path / "disk", "size=1m") as disk:
        save_state(state(1.0), disk / "stage")
        full(disk, 100_000)
        with pytest.raises(ProjectError, match="No space left"):
            save_state(state(2.0), disk / "stage")
        kept = load_state(disk / "stage", {"of": "a test"})
        assert kept is not None and float(kept.model["w"][0]) == 1
        assert [path.name for path in (disk / "stage").iterdir()] == ["state.pt"]


def test_sums_name_no_file_outside_of_their_round(tmp_path):
    from gvtools.runs.digests import SUMS, check_sums

    (tmp_path / "secret").write_text("x")
    folder = tmp_path / "round_000"
    folder.mkdir()
    (folder / SUMS).write_text(f"{'0' * 64}  ../secret\n")
    with pytest.raises(ProjectError, match="outside"):
        check_sums(folder)


def test_a_run_that_was_copied_reads_without_its_sums(run, tmp_path):
    """Runs of earlier versions have none, nor sums or figures of their own."""
    from gvtools.runs.run import load_run

    copy = Path(shutil.copytree(run, tmp_path / "run"))
    for path in (*copy.rglob("SHA256SUMS"), copy / "metrics.json"):
        path.unlink()
    assert len(list(load_run(copy).targets())) == 2


ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_two_hundred_kills_lose_nothing(tmp_path):
    """In a process of its own, which forks before it has threads."""
    program = ROOT / "tests" / "fixtures" / "kill_runs.py"
    done = subprocess.run(
        [sys.executable, str(program), str(tmp_path / "kills"), "--kills", "200"],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    cases = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, done.stderr[-2000:]
    assert [case for case in cases if case["problem"]] == []
    assert sum(case["kills"] for case in cases) >= 200
    assert len({case["command"] for case in cases}) >= 15
