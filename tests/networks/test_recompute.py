from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import geoverse_models as micro
import pytest
import torch

from gvtools.networks.compute import Recomputing, set_recompute
from gvtools.training.batch import TrainingBatch
from gvtools.training.denoiser_stage import DenoiserStage
from gvtools.training.draws import Draws
from gvtools.training.encoder_stage import EncoderStage
from gvtools.training.options import (
    DenoiserStageOptions,
    EncoderStageOptions,
    OptimizerOptions,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def batch() -> TrainingBatch:
    views = micro.batch(2)
    return TrainingBatch(views, torch.rand_like(views.images), 2 + torch.rand_like(views.depth))


def gradients(stage: Any, dtype: torch.dtype) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    draws = Draws(0, stage.name, 0, (0, 1))
    torch.manual_seed(0)
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        loss, _ = stage(batch(), draws)
    loss.backward()
    found = {name: p.grad for name, p in stage.named_parameters() if p.grad is not None}
    return loss.detach(), found


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(
    ("stage", "options", "parts"),
    [
        (DenoiserStage, DenoiserStageOptions, ("level1", "cascade", "control")),
        (EncoderStage, EncoderStageOptions, ("geometry.backbone", "geometry.head", "rgb_head")),
    ],
)
def test_the_same_loss_and_gradients_to_the_last_bit(stage, options, parts, dtype, monkeypatch):
    found = []
    ran: dict[str, int] = {}
    layer = Recomputing.layer

    def counted(self: Any, run: Any, *inputs: Any) -> Any:
        def running(*given: Any) -> Any:
            ran[type(self).__name__] = ran.get(type(self).__name__, 0) + 1
            return run(*given)

        return layer(self, running, *inputs)

    monkeypatch.setattr(Recomputing, "layer", counted)
    counts = []
    for recompute in (False, True):
        ran.clear()
        torch.manual_seed(1)
        model = micro.model(micro.config(injection="control"))
        prior = SimpleNamespace(features=lambda *_, **__: micro.video_features(2, 4))
        model.attach_video(prior)  # type: ignore[arg-type]
        made = stage(model, options(optimizer=OptimizerOptions(recompute=recompute)))
        found.append(gradients(made, dtype))
        counts.append(dict(ran))
    (loss, plain), (again, recomputed) = found
    assert torch.equal(loss, again)
    assert plain.keys() == recomputed.keys() and len(plain) > 10
    for part in parts:
        assert any(name.startswith(f"model.{part}.") for name in plain)
    for name, gradient in plain.items():
        assert torch.equal(gradient, recomputed[name]), name
    # What carries a gradient ran twice.
    assert all(counts[1][name] > counts[0][name] for name in counts[0])


def test_nothing_runs_twice_without_gradients():
    model = micro.model()
    set_recompute(model, True)
    assert {type(m).__name__ for m in model.modules() if isinstance(m, Recomputing)} == {
        "Denoiser", "RGBHead", "Backbone", "GeometryHead"
    }  # fmt: skip
    ran = []
    model.level1.blocks[0].register_forward_hook(lambda *_: ran.append(1))
    model.generate(micro.batch(), bounds=(1.0, 0.0))
    assert len(ran) == 1
