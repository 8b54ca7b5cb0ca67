"""Fits of four kinds of captures: never worse than no fit, and not worse by more time."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from benchmarks.made_scenes import PLACES, write_place
from pipelines.cli import main

pytestmark = pytest.mark.slow

# How much worse a fit may be than none, and a longer fit than a shorter one [dB].
THAN_NONE, THAN_SHORTER = 0.2, 0.1


@pytest.mark.parametrize("name", ["object indoors", "facade", "street", "from above"])
def test_a_fit_never_hurts(tmp_path, name):
    place = PLACES[name]
    write_place(tmp_path / "scan", replace(place, views=14, size=(320, 240)))

    def psnr(seconds):
        out = tmp_path / f"run-{seconds}"
        words = ["--context", "not:every:5+2", "--targets", "every:5+2", "--refine", str(seconds)]
        assert (
            main(["reconstruct", str(tmp_path / "scan"), "--out", str(out), "--quiet", *words]) == 0
        )
        return json.loads((out / "metrics.json").read_text())["psnr"]

    none, short, long = (psnr(seconds) for seconds in (0, 10, 30))
    assert short > none - THAN_NONE
    assert long > max(none - THAN_NONE, short - THAN_SHORTER)
