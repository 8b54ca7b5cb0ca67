"""Files of a run that were cut off or hold a flipped bit: told by name, or without effect."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hostile.judge import digest
from kill_commands import FIT, settings
from tiny_scan import write_scan

from gvtools.depth.source import DepthMap
from gvtools.errors import GvError, ProjectError
from gvtools.runs.context_depth import UNREADABLE, read_context_depth, write_context_depth
from gvtools.runs.poses import RunPoses
from gvtools.runs.run import load_appearance, load_memory, load_run
from gvtools.training.loop import StageState, TrainingProgress, load_state, save_state
from pipelines.cli import main
from pipelines.reconstruction.fitting import Fitted


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run with Gaussians."""
    folder = tmp_path_factory.mktemp("damaged")
    scan = write_scan(folder / "scan", views=6)
    out = folder / "run"
    words = ["reconstruct", str(scan), "--out", str(out), "--quiet", *settings(*FIT)]
    assert main(words) == 0
    return out


@pytest.fixture
def run(whole, tmp_path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "run"))


def cut(path: Path, share: float = 0.6) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def flip(path: Path, place: int, bit: int = 3) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1 << bit
    path.write_bytes(content)


def read_all(run: Path) -> None:
    """Everything that readers of a run read, its pictures included."""
    loaded = load_run(run)
    load_memory(run)
    load_appearance(run)
    for _ in loaded.targets():
        pass


def said(run: Path) -> str:
    with pytest.raises(GvError) as caught:
        read_all(run)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def resumed(run: Path) -> int:
    project = json.loads((run / "run.json").read_text())["project"]
    words = ["reconstruct", project, "--out", str(run), "--resume", "--quiet"]
    return main([*words, *settings(*FIT)])


READ = ("run.json", "round_000/report.json", "round_001/report.json", "memory.npz",
        "round_000/appearance.npz", "round_001/generated_*.png", "round_001/valid_*.png",
        "round_001/depth_*.npz")  # fmt: skip


@pytest.mark.parametrize("name", READ)
@pytest.mark.parametrize("share", [0.0, 0.6, 0.97])
def test_a_file_that_was_cut_off_is_named(run, name, share):
    (path,) = run.glob(name)
    cut(path, share)
    message = said(run)
    assert path.name in message or str(path.parent) in message, message


def test_what_only_people_read_is_written_anew(run, whole):
    """rounds.jsonl, metrics.json and the PLY are made of the others by the next --resume."""
    for name in ("rounds.jsonl", "metrics.json", "memory.ply"):
        cut(run / name)
    assert resumed(run) == 0
    assert (run / "rounds.jsonl").read_bytes() == (whole / "rounds.jsonl").read_bytes()
    assert (run / "memory.ply").read_bytes() == (whole / "memory.ply").read_bytes()
    json.loads((run / "metrics.json").read_text())


OWN: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "metrics.json": (load_run, ("report",)),
    "memory.ply": (load_memory, ("export", "--format", "ply", "--out", "copy.ply")),
}


@pytest.mark.parametrize("name", OWN)
def test_a_flipped_bit_of_a_runs_figures_or_points_is_named(run, monkeypatch, name, capsys):
    path, (read, (command, *words)) = run / name, OWN[name]
    place = path if name == "memory.ply" else run
    before = path.read_bytes()
    for share in (0.1, 0.5, 0.95):
        flip(path, int(share * len(before)), 0)
        with pytest.raises(ProjectError, match=f"{name}: damaged"):
            read(place)
        path.write_bytes(before)
    read(place)
    flip(path, len(before) // 2, 0)
    monkeypatch.chdir(run)
    assert main([command, str(place), *words, "--quiet"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"{path}: damaged" in line and f"or remove {run} and" not in line


def test_the_sums_of_a_run_are_sha256sums(run):
    lines = [line.split("  ") for line in (run / "SHA256SUMS").read_text().splitlines()]
    assert [name for _, name in lines] == ["memory.ply", "metrics.json"]
    for total, name in lines:
        assert hashlib.sha256((run / name).read_bytes()).hexdigest() == total


def told(
    path: Path, read: Callable[[], Any], errors: tuple[type[Exception], ...] = (GvError,)
) -> int:
    """How many of 60 flipped bits are told, by the name of the file; the others have no effect."""
    before, expected, found = path.read_bytes(), digest(read()), 0
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(before), 60).tolist():
        path.write_bytes(before)
        flip(path, place, int(rng.integers(8)))
        try:
            assert digest(read()) == expected
        except errors as error:
            found += 1
            named = path.name in str(error) or path.parent.name in str(error)
            assert named or not isinstance(error, GvError), error
    return found


def target_of(run: Path) -> dict[str, Any]:
    files = load_run(run).views[0].read()
    return {name: value for name, value in vars(files).items() if name != "camera"}


def fit_of(run: Path) -> Any:
    path = run / "round_000" / "appearance.npz"
    return Fitted.load(path).appearance.arrays(), RunPoses.load(path)


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("round_000/appearance.npz", fit_of),
        ("round_001/depth_*.npz", target_of),
        ("round_001/generated_*.png", target_of),
        ("round_001/valid_*.png", target_of),
    ],
)
def test_a_flipped_bit_of_a_run_is_named_or_without_effect(run, name, read):
    (path,) = run.glob(name)
    assert told(path, lambda: read(run)) > 30


def test_a_flipped_bit_of_context_depth_is_told(tmp_path):
    path = tmp_path / "context_depth_a.npz"
    depth = np.linspace(1, 2, 48 * 64, dtype=np.float32).reshape(48, 64)
    shown = DepthMap(depth, np.ones_like(depth), "test")
    write_context_depth(path, shown, failed="", picture=np.zeros((48, 64, 3), np.uint8))
    assert told(path, lambda: read_context_depth(path, (48, 64)), UNREADABLE) > 30


@pytest.mark.parametrize("mapped", [False, True])
def test_a_flipped_bit_of_a_training_state_is_named(tmp_path, mapped):
    weights = {"w": torch.ones(60_000)}
    save_state(StageState({"of": "a test"}, TrainingProgress(step=3), weights), tmp_path)

    def model() -> Any:
        kept = load_state(tmp_path, {"of": "a test"}, mapped=mapped)
        assert kept is not None
        return {name: value.numpy() for name, value in kept.model.items()}

    assert told(tmp_path / "state.pt", model) > 40


@pytest.mark.parametrize(
    "name", ["report.json", "generated_*.png", "guidance_*.png", "after_*.png"]
)
def test_a_flipped_bit_is_named_when_the_run_goes_on(run, name, capsys):
    (path,) = (run / "round_001").glob(name)
    flip(path, path.stat().st_size // 2, 0)
    assert resumed(run) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert path.name in line and ("damaged" in line or "no readable report" in line)


@pytest.mark.parametrize(("name", "value"), [("completion", np.nan), ("completion", -1),
                                             ("confidence", np.inf)])  # fmt: skip
def test_numbers_that_no_target_has_are_named(run, name, value):
    (path,) = run.glob("round_001/depth_*.npz")
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays[name][3, 4] = value
    np.savez(path, **arrays)
    (path.parent / "SHA256SUMS").unlink()
    assert "not finite" in said(run)
