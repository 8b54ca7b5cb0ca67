"""Files of a run that were cut off or hold a flipped bit: told by name, or without effect."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from kill_commands import FIT, settings
from tiny_scan import write_scan

from gvtools.errors import GvError, ProjectError
from gvtools.runs.context_depth import UNREADABLE, read_context_depth
from gvtools.runs.poses import RunPoses
from gvtools.runs.run import load_appearance, load_memory, load_run
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


def test_a_run_without_figures_or_sums_is_taken_as_it_is(run):
    (run / "metrics.json").unlink()
    read_all(run)
    (run / "SHA256SUMS").unlink()
    flip(run / "memory.ply", -1)
    load_memory(run / "memory.ply")


ARRAYS = ("round_000/appearance.npz", "round_001/depth_*.npz")


@pytest.mark.parametrize("name", ARRAYS)
def test_a_flipped_bit_of_arrays_is_named_or_without_effect(run, whole, name):
    (path,) = run.glob(name)
    (before,) = whole.glob(name)
    rng = np.random.default_rng(0)
    found = 0
    for place in rng.integers(0, path.stat().st_size, 40).tolist():
        shutil.copyfile(before, path)
        flip(path, place, int(rng.integers(8)))
        try:
            if "appearance" in name:
                Fitted.load(path)
                RunPoses.load(path)
            else:
                depth = load_run(run).views[0].read().depth
                np.testing.assert_array_equal(depth, load_run(whole).views[0].read().depth)
                continue
        except GvError as error:
            found += 1
            assert path.name in str(error) or path.parent.name in str(error)
        else:
            _assert_same_arrays(path, before)
    assert found > 20


def _assert_same_arrays(path: Path, before: Path) -> None:
    with np.load(path) as mine, np.load(before) as theirs:
        for key in theirs.files:
            np.testing.assert_array_equal(mine[key], theirs[key], err_msg=key)


@pytest.mark.parametrize(
    "name", ["report.json", "generated_*.png", "guidance_*.png", "after_*.png"]
)
def test_a_flipped_bit_is_named_when_the_run_goes_on(run, name, capsys):
    (path,) = (run / "round_001").glob(name)
    flip(path, path.stat().st_size // 2, 0)
    assert resumed(run) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert path.name in line and ("damaged" in line or "no readable report" in line)


@pytest.mark.parametrize("kind", ["generated", "valid"])
def test_a_flipped_bit_of_a_picture_is_named_or_without_effect(run, whole, kind):
    (path,) = run.glob(f"round_001/{kind}_*.png")
    before = path.read_bytes()
    expected = load_run(whole).views[0].read()
    rng = np.random.default_rng(1)
    found = 0
    for place in rng.integers(0, len(before), 40).tolist():
        path.write_bytes(before)
        flip(path, place, int(rng.integers(8)))
        try:
            files = load_run(run).views[0].read()
        except GvError as error:
            found += 1
            assert path.parent.name in str(error)
        else:
            np.testing.assert_array_equal(files.picture, expected.picture)
            np.testing.assert_array_equal(files.observed, expected.observed)
    assert found > 20


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


def test_context_depth_is_checked(tmp_path):
    from gvtools.depth.source import DepthMap
    from gvtools.runs.context_depth import write_context_depth

    path = tmp_path / "context_depth_a.npz"
    depth = np.linspace(1, 2, 48 * 64, dtype=np.float32).reshape(48, 64)
    write_context_depth(
        path, DepthMap(depth, np.ones_like(depth), "test"), failed="",
        picture=np.zeros((48, 64, 3), np.uint8),
    )  # fmt: skip
    before = path.read_bytes()
    rng = np.random.default_rng(2)
    for place in rng.integers(0, len(before), 60).tolist():
        path.write_bytes(before)
        flip(path, place, int(rng.integers(8)))
        try:
            found, failed = read_context_depth(path, (48, 64))
        except UNREADABLE:
            continue
        np.testing.assert_array_equal(found.depth, depth)
        assert failed == ""
