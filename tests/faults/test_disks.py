"""A disk that is full, a folder that cannot be written: one line, and what was there stays."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from kill_commands import PLAIN
from kill_contents import contents

from gvtools.errors import ProjectError
from gvtools.training.loop import StageState, TrainingProgress, load_state, save_state
from pipelines.cli import main

RUN = (*PLAIN, "--quiet")


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
