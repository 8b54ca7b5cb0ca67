from __future__ import annotations

import json
import subprocess
import sys
import weakref
from pathlib import Path

import geoverse_models as micro
import pytest
import torch
from command_line import run_command

from benchmarks.memory import CASES, peak, predicted_peak
from gvtools.errors import OptionError
from pipelines.bench.memory import LiveBytes, StagePeaks, alone, card_line, fake_tensors

pytestmark = pytest.mark.usefixtures("one_thread")

REPOSITORY = Path(__file__).resolve().parents[3]


# Counting.


def test_bytes_are_counted_once_and_forgotten_when_they_are_given_back():
    with LiveBytes() as live:
        a = torch.zeros(100)
        assert live.live == 400
        b = a.view(10, 10)[2:].t()
        a.add_(1)
        assert live.live == 400
        c = a + b.sum()
        assert live.live == 800 and live.peak == 804
        del a
        assert live.live == 800  # ``b`` still looks at it
        del b
        assert live.live == 400 and live.peak == 804
        live.forget_peak()
        assert live.peak == 400
        del c
    assert live.live == 0


def test_weights_are_counted_elsewhere():
    layer = torch.nn.Linear(10, 30)
    x = torch.zeros(5, 10)
    with LiveBytes([layer]) as live:
        y = layer(x)
        assert live.peak == 5 * 30 * 4
        y.sum().backward()
        del y
        assert live.live == (10 * 30 + 30) * 4  # the gradients


def test_nothing_is_allocated_for_what_is_predicted():
    with fake_tensors(), LiveBytes() as live:
        made = torch.zeros(2**40)
        made = made * 2
        assert live.live == 4 * 2**40
        alive = weakref.ref(made)
        del made
        assert alive() is None and live.live == 0 and live.peak == 8 * 2**40


def test_peaks_by_stage():
    with LiveBytes() as live:
        peaks = StagePeaks(live)
        with peaks("hint encoding"):
            kept = torch.zeros(100)
        with peaks("decoding"):
            torch.zeros(50).sum()
            with peaks("RGB head"):
                torch.zeros(200)
    assert len(kept) == 100
    assert peaks.rows == {"hint encoding": 400, "decoding": 1200, "decoding: RGB head": 1200}


# What is predicted is what is counted where the same code runs with numbers.


@pytest.mark.slow
def test_what_is_predicted_is_what_is_counted_with_numbers():
    found = {case: alone(predicted_peak, case, "tiny", 48) for case in CASES}
    for case, before in found.items():
        assert before == pytest.approx(alone(peak, case, "tiny", 48), rel=0.01)
    assert all(found.values())


# The command.


def run(*words: object) -> None:
    run_command("bench", "complete", *words)


@pytest.mark.slow
def test_the_tables_and_the_figures(tmp_path):
    weights = micro.weights_folder(tmp_path / "weights")
    command = [sys.executable, "-m", "pipelines.cli", "bench", "complete", "--memory"]
    command += ["--weights", str(weights), "--size", "32", "--steps", "1", "--targets", "1"]
    command += ["--precision", "float16", "--card", "24"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    for said in (
        "micro, 2 + 1 views of 32x32, 1 + 1 steps, float16: peak memory of a pass, GB",
        "a training step of one sample, float32",
        "reflow",
        "level-1 step",
        "a card of 24 GB: a pass without the video prior fits (0.",
    ):
        assert said in done.stdout
    file = tmp_path / "memory.json"
    subprocess.run([*command, "--json", str(file)], cwd=REPOSITORY, check=True)
    figures = json.loads(file.read_text())
    assert figures["precision"] == "float16" and figures["card_gb"] == 24
    assert len(figures["training"]) == 4
    for row in figures["training"]:
        assert row["total_bytes"] >= row["lasting_bytes"] > row["weights_bytes"] > 0


def test_what_fits_a_card():
    figures = {
        "inference": [{"model": "M", "total_bytes": 3e9}, {"model": "M", "total_bytes": 7e9}],
        "training": [
            {"model": "M", "stage": "S", "recompute": False, "total_bytes": 30e9},
            {"model": "M", "stage": "S", "recompute": True, "total_bytes": 9e9},
        ],
    }
    assert card_line(figures, 8) == (
        "a card of 8 GB: a pass M fits (7); training S M and with recompute does not fit (9)"
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--card", 24), "--card is of --memory"),
        (("--memory", "--compile"), "expected one of --memory"),
        (("--memory", "--predict"), "expected one of --memory"),
        (("--predict", "--compile"), "expected one of --memory"),
        (("--memory", "--card", 0), "more than 0"),
    ],
)
def test_options_that_do_not_fit(words, said):
    with pytest.raises(OptionError, match=said):
        run(*words)
