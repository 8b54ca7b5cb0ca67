"""Passes of the generative core whose holes are small take less."""

from __future__ import annotations

from typing import Any

import geoverse_models as micro
import numpy as np
import pytest

from gvtools.completers import create
from gvtools.completers.geoverse import completer as completer_module
from gvtools.completers.geoverse import from_pretrained
from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.holes import hole_radius
from gvtools.guidance import Guidance

pytest.importorskip("safetensors", reason="weights are read with safetensors")
pytestmark = pytest.mark.usefixtures("one_thread")


def radii(known: Guidance) -> list[float]:
    return [hole_radius(valid) for valid in known.valid]


def test_passes_with_small_holes_take_one_step_in_half_the_size(weights, monkeypatch):
    context, known = micro.context_views(1), micro.guidance(3, size=(24, 32))
    sizes: list[int] = []
    generate = GeoVerse.generate

    def watched(self: GeoVerse, batch: ViewBatch, **options: Any) -> Any:
        sizes.append(batch.images.shape[-1])
        return generate(self, batch, **options)

    monkeypatch.setattr(GeoVerse, "generate", watched)
    # One target a pass.
    options = {"weights": str(weights), "device": "cpu", "alignment": "hint", "views": 2}
    least, middle, most = sorted(radii(known))
    assert least < most
    whole = len(from_pretrained(weights).config.flow.level1) - 1
    between = (middle + most) / 2
    cases: list[tuple[float, dict[str, Any], int, int]] = [
        (0.0, {}, 3 * whole, 0),
        (between, {}, 2 + whole, 2),
        (1.0, {}, 3, 3),
        # What the user asks for stands.
        (1.0, {"steps": 2}, 6, 3),
        (1.0, {"steps": 0}, 0, 3),
    ]
    for below, own, steps, halved in cases:
        sizes.clear()
        completer = create("geoverse", **options, **own).with_reduced_effort(below)
        assert completer.complete(context, known).spent["steps"] == steps, (below, own)
        assert sizes.count(micro.SIZE[1] // 2) == halved
        assert sizes.count(micro.SIZE[1]) == 3 - halved


@pytest.mark.parametrize("injection", ["control", "shared"])
def test_passes_with_small_holes_do_without_the_video_prior(tmp_path, monkeypatch, injection):
    model = micro.model(micro.config(injection=injection))
    weights = micro.weights_folder(tmp_path, model.config)
    (weights / "video").mkdir()
    monkeypatch.setattr(completer_module, "from_pretrained", lambda *where, **options: model)
    context, known = micro.context_views(1), micro.guidance(3, size=(24, 32))
    asked: list[int] = []

    def features(self: GeoVerse, batch: ViewBatch, seeds: Any) -> Any:
        asked.append(1)
        return micro.video_features(*batch.images.shape[:2])

    monkeypatch.setattr(GeoVerse, "_video_features", features)
    completer = create("geoverse", weights=str(weights), device="cpu", alignment="hint", views=2)

    def completed(below: float) -> np.ndarray:
        asked.clear()
        return completer.with_reduced_effort(below).complete(context, known).rgb

    everywhere = completed(0.0)
    assert len(asked) == 3
    nowhere = completed(1.0)
    assert not asked
    middle = (min(radii(known)) + max(radii(known))) / 2
    mixed = completed(middle)
    assert len(asked) == sum(radius > middle for radius in radii(known)) in (1, 2)
    for row, radius in enumerate(radii(known)):
        assert np.array_equal(mixed[row], (everywhere if radius > middle else nowhere)[row])
        assert not np.array_equal(everywhere[row], nowhere[row])
