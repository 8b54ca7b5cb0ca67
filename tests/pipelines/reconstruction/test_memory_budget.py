from __future__ import annotations

import json
from pathlib import Path

import pytest
from run_files import Killed, reconstructed
from tiny_scan import write_scan

from gvtools.memory.store import tile_set
from pipelines.cli import main
from pipelines.reconstruction import run as runs

SETTINGS = (
    "context=first:3", "targets=range:3-5", "views_per_round=2", "completer=inpaint",
    "refine.steps=0", "savings.pixel_binning=0", "fusion.max_psnr_drop_db=none",
)  # fmt: skip
TINY = "memory.budget=1MB"


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("scan"))


@pytest.fixture(scope="module")
def in_ram(scan, tmp_path_factory):
    return run(scan, tmp_path_factory.mktemp("runs") / "ram")


@pytest.fixture(scope="module")
def tiled(scan, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tile_set, "SMALLEST", 1)
        return run(scan, tmp_path_factory.mktemp("runs") / "tiled", TINY)


def run(scan: Path, out: Path, *settings: str, resume: bool = False) -> Path:
    return reconstructed(scan, out, *SETTINGS, *settings, resume=resume)


def figures(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


def assert_same_results(out: Path, expected: Path) -> None:
    assert figures(out) == figures(expected)
    pictures = {p.relative_to(expected) for p in expected.glob("round_*/*.png")}
    assert pictures and pictures == {p.relative_to(out) for p in out.glob("round_*/*.png")}
    for name in pictures:
        assert (out / name).read_bytes() == (expected / name).read_bytes(), name


def test_figures_and_pictures_do_not_depend_on_the_budget(tiled, in_ram):
    assert (in_ram / "memory.npz").is_file() and not (in_ram / "memory.tiles").exists()
    assert (tiled / "memory.tiles").is_dir() and not (tiled / "memory.npz").exists()
    assert len(list((tiled / "memory.tiles").glob("*.tile"))) > 2
    # Only the run's own is left, and nothing of the work.
    assert not list(tiled.glob("round_*/memory*")) and not list(tiled.glob(".*.part"))
    assert_same_results(tiled, in_ram)


@pytest.mark.parametrize(
    "budget",
    [TINY, pytest.param("memory.budget=100MB", marks=pytest.mark.slow), "memory.budget=none"],
)
def test_a_run_goes_on_after_a_kill_with_any_budget(
    scan, tiled, in_ram, tmp_path, monkeypatch, budget
):
    monkeypatch.setattr(tile_set, "SMALLEST", 1)
    out, real = tmp_path / "run", runs.complete_round

    def until_round_2(plan, targets, number, **options):
        if number == 2:
            raise Killed
        return real(plan, targets, number, **options)

    with monkeypatch.context() as patch:
        patch.setattr(runs, "complete_round", until_round_2)
        with pytest.raises(Killed):
            run(scan, out, TINY)
    assert (out / "round_001" / "memory.tiles").is_dir()
    run(scan, out, budget, resume=True)
    assert_same_results(out, in_ram)


def test_render_export_and_view_read_tiles(scan, tiled, in_ram, tmp_path, capsys):
    for name, path in (("tiled", tiled), ("ram", in_ram)):
        out = str(tmp_path / name)
        assert main(["render", str(path), "--cameras", str(scan), "--out", out, "--quiet"]) == 0
        file = str(tmp_path / f"{name}.ply")
        assert main(["export", str(path), "--format", "ply", "--out", file, "--quiet"]) == 0
    pictures = sorted((tmp_path / "ram").rglob("*.png"))
    assert pictures
    for picture in pictures:
        other = tmp_path / "tiled" / picture.relative_to(tmp_path / "ram")
        assert other.read_bytes() == picture.read_bytes()
    assert (tmp_path / "tiled.ply").stat().st_size == (tmp_path / "ram.ply").stat().st_size
    shot = tmp_path / "shot.png"
    assert main(["view", str(tiled), "--screenshot", str(shot), "--quiet"]) == 0
    assert shot.stat().st_size > 1000
