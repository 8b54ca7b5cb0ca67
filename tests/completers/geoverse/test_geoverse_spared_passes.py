"""Passes of the generative core whose holes are near what is known take less."""

from __future__ import annotations

from typing import Any

import geoverse_models as micro
import numpy as np
import pytest
from test_geoverse_completer import complete, weights

from gvtools.completers.geoverse import completer as completer_module
from gvtools.completers.geoverse import from_pretrained
from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.holes import hole_reach

pytest.importorskip("safetensors", reason="weights are read with safetensors")
pytestmark = pytest.mark.usefixtures("one_thread")
__all__ = ["weights"]


def test_passes_whose_holes_are_near_what_is_known_take_one_step(weights, monkeypatch):
    context, known = micro.context_views(1), micro.guidance(3, size=(24, 32))
    reach = sorted(hole_reach(valid) for valid in known.valid)
    assert reach[0] < reach[-1]
    middle = (reach[-2] + reach[-1]) / 2
    whole = len(from_pretrained(weights).config.flow.level1) - 1
    cases: list[tuple[dict[str, Any], int]] = [
        ({}, 3 * whole),
        ({"one_step_holes": middle}, 2 + whole),
        ({"one_step_holes": 1.0}, 3),
        ({"one_step_holes": 1.0, "steps": 2}, 6),
        ({"one_step_holes": 1.0, "steps": 0}, 0),
    ]
    for options, steps in cases:
        # One target a pass.
        made = complete(weights, context, known, views=2, **options)
        assert made.spent["steps"] == steps, options


@pytest.mark.parametrize("injection", ["control", "shared"])
def test_passes_whose_holes_are_near_what_is_known_do_without_the_video_prior(
    tmp_path, monkeypatch, injection
):
    model = micro.model(micro.config(injection=injection))
    weights = micro.weights_folder(tmp_path, model.config)
    (weights / "video").mkdir()
    monkeypatch.setattr(completer_module, "_loaded", lambda *where: model)
    context, known = micro.context_views(1), micro.guidance(3, size=(24, 32))
    reach = [hole_reach(valid) for valid in known.valid]
    asked: list[int] = []

    def features(self: GeoVerse, batch: ViewBatch, seeds: Any) -> Any:
        asked.append(1)
        return micro.video_features(*batch.images.shape[:2])

    monkeypatch.setattr(GeoVerse, "_video_features", features)

    def made(no_prior: float) -> np.ndarray:
        asked.clear()
        # One target a pass.
        return complete(weights, context, known, views=2, no_prior_holes=no_prior).rgb

    everywhere = made(0.0)
    assert len(asked) == 3
    nowhere = made(1.0)
    assert not asked
    middle = (min(reach) + max(reach)) / 2
    mixed = made(middle)
    assert len(asked) == sum(far > middle for far in reach) in (1, 2)
    for row, far in enumerate(reach):
        assert np.array_equal(mixed[row], (everywhere if far > middle else nowhere)[row])
        assert not np.array_equal(everywhere[row], nowhere[row])
