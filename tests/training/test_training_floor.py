"""A clean prediction's velocity has a floor in time; what it is trained towards has it as well."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from gvtools.completers.geoverse.flow import interpolate, velocity_from_clean, velocity_target
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.training.batch import Draws
from gvtools.training.data import TrainingSamples
from gvtools.training.options import ReflowStageOptions, shipped_or_read
from gvtools.training.stages import ReflowStage

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def model() -> GeoVerse:
    torch.manual_seed(0)
    config, folder = shipped_or_read("micro")
    chosen = config.network(folder)
    # The last interval lies within the floor.
    flow = replace(chosen.flow, prediction="clean", least_time=0.2, level1=(1.0, 0.4, 0.1, 0.0))
    return GeoVerse(replace(chosen, flow=flow))


@pytest.mark.parametrize("time", [0.01, 0.1, 0.2, 0.7, 1.0])
def test_the_right_clean_prediction_has_no_error_at_any_time(model, time):
    clean, noise = torch.randn(2, 2, 3, 4, 5, 6)
    t = torch.tensor([time, 0.5])
    state = interpolate(clean, noise, t)
    least = model.config.flow.least_time
    given = velocity_from_clean(clean, state, t, least=least)
    wanted = model.velocity_wanted(velocity_target(clean, noise), t)
    torch.testing.assert_close(given, wanted, rtol=1e-4, atol=1e-4)
    plain = replace(
        model.config, flow=replace(model.config.flow, prediction="velocity", skip=False)
    )
    other = GeoVerse(plain)
    assert torch.equal(other.velocity_wanted(noise, t), noise)


def test_a_denoiser_that_is_right_has_nothing_to_distil(model, monkeypatch):
    """Its steps end in the clean latents, whatever the interval; noise left there is no teacher."""
    config, _ = shipped_or_read("micro")
    samples = TrainingSamples(config, model.config)
    batch = samples.batch(range(4))
    _, clean = model.clean_latents(batch.true_views)

    def right(self: GeoVerse, prepared: Any, state: Tensor, t: Tensor, **options: Any) -> Tensor:
        least = options.get("least") or self.config.flow.least_time
        # A gradient, as of a network.
        zero = 0 * next(self.level1.parameters()).sum()
        return velocity_from_clean(clean + zero, state, t, least=least)

    monkeypatch.setattr(GeoVerse, "velocity1", right)
    stage = ReflowStage(model, ReflowStageOptions(steps=4))
    for number in range(4):
        _, terms = stage(batch, Draws(0, "reflow", number, (0, 1, 2, 3)))
        assert float(terms["reflow"].detach()) < 1e-6 and float(terms["flow"].detach()) < 1e-6
