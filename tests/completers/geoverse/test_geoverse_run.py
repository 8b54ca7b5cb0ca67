"""``gvtools reconstruct --completer geoverse``: a whole run with a micro model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import geoverse_models as micro
import pytest
from run_files import results, untimed
from tiny_scan import write_scan

from gvtools.completers.geoverse.completer import GeoVerseCompleter
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("one_thread", "unpainted")

OPTIONS = ("--context", "first:2", "--targets", "range:2-5", "--views-per-round", "2")


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    return write_scan(tmp_path_factory.mktemp("scan"))


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    return micro.weights_folder(tmp_path_factory.mktemp("weights") / "micro")


@pytest.fixture(scope="module")
def whole(scan, weights, tmp_path_factory) -> Path:
    """An uninterrupted run of two rounds after the photographs' own."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    assert reconstruct(scan, weights, out) == 0
    return out


def reconstruct(scan: Path, weights: Path, out: Path, *words: str) -> int:
    """Exit status of the command."""
    given = ("--completer", "geoverse", "--set", f"completer.weights={weights}", "--quiet")
    return main(
        ["reconstruct", str(scan), "--refine", "0", "--out", str(out), *OPTIONS, *given, *words]
    )


def test_a_dry_run_says_what_it_would_do_and_computes_nothing(
    scan, weights, tmp_path, capsys, monkeypatch
):
    def called(*args, **options):
        raise AssertionError("a dry run completes nothing")

    monkeypatch.setattr(GeoVerseCompleter, "complete", called)
    given = ("--completer", "geoverse", "--set", f"completer.weights={weights}", "--dry-run")
    assert (
        main(
            [
                "reconstruct",
                str(scan),
                "--refine",
                "0",
                "--out",
                str(tmp_path / "run"),
                *OPTIONS,
                *given,
            ]
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "geoverse" in said and "dry run" in said
    assert not (tmp_path / "run").exists()


def test_a_run_ends_with_its_files(whole):
    assert {"run.json", "rounds.jsonl", "metrics.json", "memory.npz"} <= {
        path.name for path in whole.iterdir()
    }
    rounds = untimed(whole)
    assert [entry["round"] for entry in rounds] == [0, 1, 2]
    for number in range(3):
        assert (whole / f"round_{number:03d}" / "report.json").is_file()
    assert len(SpatialMemory.load(whole / "memory.npz")) == rounds[-1]["points"] > 0
    assert len(json.loads((whole / "run.json").read_text(encoding="utf-8"))["weights"]) == 64


def lose_the_last_round(scan: Path, weights: Path, out: Path, whole: Path) -> None:
    """A finished run without its last round's folder."""
    shutil.copytree(whole, out)
    shutil.rmtree(out / "round_002")


def stop_in_the_last_round(scan: Path, weights: Path, out: Path, whole: Path) -> None:
    """A run that is interrupted when its last round is to be completed."""
    complete = GeoVerseCompleter.complete
    calls = []

    def stopping(self, *args, **options):
        calls.append(self)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return complete(self, *args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GeoVerseCompleter, "complete", stopping)
        assert reconstruct(scan, weights, out) == 1
    assert (out / "round_001").is_dir() and not (out / "round_002").exists()


@pytest.mark.parametrize("stop", [lose_the_last_round, stop_in_the_last_round])
def test_resuming_after_a_stop_between_rounds_gives_the_same_bytes(
    whole, scan, weights, tmp_path, capsys, stop
):
    out = tmp_path / "run"
    stop(scan, weights, out, whole)
    capsys.readouterr()
    assert reconstruct(scan, weights, out, "--resume") == 0
    assert results(out) == results(whole)
    assert untimed(out) == untimed(whole)


def test_changed_weights_refuse_to_resume(scan, tmp_path, capsys):
    folder, out = micro.weights_folder(tmp_path / "weights"), tmp_path / "run"
    assert reconstruct(scan, folder, out) == 0
    before = results(out)
    micro.weights_folder(tmp_path / "other", seed=1)
    for path in (tmp_path / "other").iterdir():
        shutil.copyfile(path, folder / path.name)
    capsys.readouterr()
    assert reconstruct(scan, folder, out, "--resume") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "another run (weights differ)" in said
    assert results(out) == before
