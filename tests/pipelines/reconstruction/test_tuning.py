from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from micro_weights import write_micro_weights
from tiny_scan import write_scan

from pipelines.cli import main
from pipelines.tuning import tune as tuning

pytestmark = pytest.mark.usefixtures("one_thread")

VIEWS = ("--context", "first:6", "--targets", "range:7-8", "--views-per-round", "1")
CORE = ("--completer", "geoverse", "--set", "effort.inpaint_below=0", "--refine", "0",
        "--set", "refine.poses=false")  # fmt: skip


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    return write_scan(tmp_path_factory.mktemp("scan"), views=9)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    return write_micro_weights(tmp_path_factory.mktemp("micro"))


def words(scan: Path, out: Path, weights: Path, *more: object) -> list[str]:
    chosen = ("--set", f"completer.weights={weights}", "--voxel", "0.03")
    return [str(w) for w in ("reconstruct", scan, "--out", out, *VIEWS, *CORE, *chosen, *more)]


STEPS = ("--set", "tune.steps=2")


@pytest.fixture(scope="module")
def run(scan, weights, tmp_path_factory) -> Path:
    """A run with weights that were found better at every look."""
    out = tmp_path_factory.mktemp("runs") / "run"
    figures = iter(np.arange(100.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning, "generated_psnr", lambda *_: float(next(figures)))
        assert main([*words(scan, out, weights, *STEPS), "--quiet"]) == 0
    return out


def pictures(run: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(run.glob("round_*/generated_*.png"))]


@pytest.mark.slow
def test_a_run_completes_with_its_tuned_weights(run, scan, weights, tmp_path):
    record = json.loads((run / "run.json").read_text())
    assert record["settings"]["tune"] == {"minutes": 0.0, "steps": 2}
    assert record["tuning"]["kept"] and record["tuning"]["steps"] == 2
    assert set(record["tuning"]["judges"]) <= set(record["context"])
    # As a run does that is given the tuned weights, and not as one with the others.
    for given, alike in ((run / "tuned", True), (weights, False)):
        out = tmp_path / f"{alike}"
        assert main([*words(scan, out, given), "--quiet"]) == 0
        assert (pictures(out) == pictures(run)) == alike
        assert not (out / "tuned").exists()


@pytest.mark.slow
def test_a_resumed_run_takes_the_weights_that_it_tuned(
    run, scan, weights, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "run"
    shutil.copytree(run, out)
    shutil.rmtree(out / "round_002")
    before = (out / "tuned" / "geoverse.safetensors").read_bytes()

    def never(*args, **options):
        raise AssertionError("tuned again")

    with monkeypatch.context() as patch:
        patch.setattr(tuning, "tune", never)
        assert main([*words(scan, out, weights, *STEPS), "--resume"]) == 0
    assert "weights tuned before" in capsys.readouterr().out
    assert pictures(out) == pictures(run)
    # Damaged ones are made again.
    shutil.rmtree(out / "round_002")
    (out / "tuned" / "geoverse.safetensors").write_bytes(before[:1000])
    figures = iter(np.arange(100.0))
    monkeypatch.setattr(tuning, "generated_psnr", lambda *_: float(next(figures)))
    assert main([*words(scan, out, weights, *STEPS), "--resume", "--quiet"]) == 0
    assert (out / "tuned" / "geoverse.safetensors").read_bytes() == before
    assert pictures(out) == pictures(run)


def test_what_cannot_be_tuned_and_another_tuning_are_refused(run, scan, weights, tmp_path, capsys):
    line = refused(capsys, *words(scan, run, weights, "--set", "tune.steps=3"), "--resume")
    assert "settings differ" in line
    out = tmp_path / "out"
    none = ("--completer", "none", "--tune", "1")
    line = refused(capsys, "reconstruct", scan, "--out", out, *none)
    assert "completer none has no weights to tune" in line
    few = ("--tune", "1", "--context", "first:3")
    assert "expected at least 4" in refused(capsys, *words(scan, out, weights, *few))
    assert not out.exists()
