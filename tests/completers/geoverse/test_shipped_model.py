"""The model that ships: small enough, recorded, and as good on a few held-out rooms as it says."""

from __future__ import annotations

import json

import pytest

from benchmarks.experiments import completion, poses
from benchmarks.experiments.classical import CLASSICAL
from benchmarks.experiments.options import ExperimentOptions
from gvtools.completers.base import create
from gvtools.completers.geoverse.completer import SHIPPED, GeoVerseCompleter
from gvtools.completers.geoverse.weights import config_of
from gvtools.training.records import STAGES

pytestmark = pytest.mark.usefixtures("one_thread")


def test_it_is_small_and_brings_its_record():
    files = [path for path in SHIPPED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 30e6
    card = (SHIPPED / "MODEL_CARD.md").read_text(encoding="utf-8")
    for word in ("gvtools train tiny", "Seed 0", "Limits", "Figures", "Data"):
        assert word in card, word
    for stage in STAGES:
        settings = json.loads((SHIPPED / f"training_{stage}.json").read_text(encoding="utf-8"))
        lines = (SHIPPED / f"log_{stage}.jsonl").read_text(encoding="utf-8").splitlines()
        assert settings["seed"] == 0
        assert json.loads(lines[-1])["step"] == settings[stage]["optimizer"]["steps"]


def test_a_completer_without_weights_uses_it():
    completer = create("geoverse")
    assert isinstance(completer, GeoVerseCompleter)
    assert completer.folder == SHIPPED
    assert config_of(SHIPPED).trained and not completer.notes


@pytest.mark.slow
def test_its_rays_give_back_the_cameras_that_it_was_told():
    found, _ = poses.run(ExperimentOptions(scenes=3))
    figures = found["true pictures, cameras told"]
    assert figures["rotation_deg_median"] < 6
    assert figures["gain_over_first_view"] > 2


@pytest.mark.slow
def test_it_completes_held_out_rooms_better_than_the_usual_fillers():
    found, _ = completion.run(ExperimentOptions(scenes=3))
    rows = {row["method"]: row for row in found["against_best_other_filler"]}
    student = rows["student 3+1"]
    others = [rows[name] for name in CLASSICAL]
    assert student["depth"] < 0.8 * min(row["depth"] for row in others)
    assert student["psnr"] > max(row["psnr"] for row in others)
