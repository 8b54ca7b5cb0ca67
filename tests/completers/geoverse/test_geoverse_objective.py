from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from gvtools.completers.geoverse.objective import (
    LossWeights,
    Objective,
    Prediction,
    Reference,
    center_similarity,
    depth_loss,
    flow_matching_loss,
    high_gradient_loss,
    objective,
    rgb_loss,
)
from gvtools.errors import OptionError

B, V, CONTEXT = 2, 5, 2
T = V - CONTEXT
TERMS = ["level1", "level0", "rgb", "hf", "depth"]


def _batch(seed: int = 0) -> tuple[Prediction, Reference]:
    generator = torch.Generator().manual_seed(seed)

    def values(*shape: int, grad: bool = False) -> torch.Tensor:
        return torch.rand(shape, generator=generator).requires_grad_(grad)

    def all_of(grad: bool) -> dict[str, torch.Tensor]:
        return {
            "level1": values(B, V, 4, 3, 3, grad=grad),
            "level0": values(B, V, 4, 3, 3, grad=grad),
            "image": values(B, T, 3, 6, 6, grad=grad),
            "depth": values(B, T, 6, 6, grad=grad),
            "centers": values(B, V, 3, grad=grad),
        }

    return Prediction(**all_of(True)), Reference(**all_of(False))


def test_the_total_is_the_weighted_sum_of_the_terms():
    prediction, reference = _batch()
    weights = LossWeights(level1=0.5, level0=2.0, rgb=3.0, hf=4.0, depth=5.0)
    found = objective(prediction, reference, context=CONTEXT, weights=weights)
    pairs = {
        field.name: (getattr(prediction, field.name), getattr(reference, field.name))
        for field in fields(Prediction)
    }
    similarity = center_similarity(*pairs["centers"])
    expected = {
        "level1": flow_matching_loss(*pairs["level1"], context=CONTEXT),
        "level0": flow_matching_loss(*pairs["level0"], context=CONTEXT),
        "rgb": rgb_loss(*pairs["image"]),
        "hf": high_gradient_loss(*pairs["image"]),
        "depth": depth_loss(*pairs["depth"], similarity=similarity),
    }
    assert list(found.terms) == TERMS
    for name, value in expected.items():
        torch.testing.assert_close(found.terms[name], value.mean())
    total = sum(getattr(weights, name) * expected[name].mean() for name in TERMS)
    torch.testing.assert_close(found.total, total)
    record = found.record()
    assert record["loss"] == pytest.approx(float(total))
    assert set(record) == {
        "loss",
        *(f"loss/{name}" for name in TERMS),
        *(f"count/{name}" for name in ("rgb_pixels", "rgb_empty", "depth_pixels", "depth_empty")),
        "count/depth_without_scale",
    }


def test_samples_are_averaged_not_pixels():
    image, wanted = torch.rand(2, B, T, 3, 6, 6, generator=torch.Generator().manual_seed(0))
    valid = torch.ones(B, T, 6, 6, dtype=torch.bool)
    valid[0, :, 1:] = False

    def of(part: slice) -> Objective:
        reference = Reference(image=wanted[part], image_valid=valid[part])
        return objective(Prediction(image=image[part]), reference, context=CONTEXT)

    alone = [of(slice(b, b + 1)) for b in range(B)]
    both = of(slice(None))
    for name in ("rgb", "hf"):
        mean = torch.stack([one.terms[name] for one in alone]).mean()
        torch.testing.assert_close(both.terms[name], mean)


def test_what_is_not_predicted_has_no_term():
    prediction, reference = _batch()
    only = Prediction(level1=prediction.level1)
    found = objective(only, reference, context=CONTEXT)
    assert list(found.terms) == ["level1"] and not found.counts
    torch.testing.assert_close(found.total, found.terms["level1"])
    with pytest.raises(OptionError, match="nothing was predicted"):
        objective(Prediction(), reference, context=CONTEXT)
    for field in fields(Prediction):
        if field.name != "centers":
            with pytest.raises(OptionError, match=f"{field.name} was predicted"):
                absent = replace(reference, **{field.name: None})
                objective(prediction, absent, context=CONTEXT)
    with pytest.raises(OptionError, match="without predicted camera centres"):
        objective(replace(prediction, centers=None), reference, context=CONTEXT)


def test_a_term_of_coefficient_zero_is_logged_but_pulls_at_nothing():
    prediction, reference = _batch()
    broken = replace(prediction, depth=torch.full((B, T, 6, 6), torch.nan, requires_grad=True))
    weights = LossWeights(depth=0.0, hf=0.0)
    found = objective(broken, reference, context=CONTEXT, weights=weights)
    assert bool(found.terms["depth"].isnan()) and not found.terms["depth"].requires_grad
    assert bool(found.total.isfinite()) and found.terms["hf"] > 0
    found.total.backward()
    assert broken.depth is not None and broken.depth.grad is None
    nothing = LossWeights(level1=0, level0=0, rgb=0, hf=0, depth=0)
    assert float(objective(prediction, reference, context=CONTEXT, weights=nothing).total) == 0


def test_missing_targets_are_counted_and_give_zero_within_the_graph():
    prediction, reference = _batch()
    assert reference.centers is not None
    found = objective(
        prediction,
        replace(
            reference,
            image_valid=torch.zeros(B, T, 6, 6, dtype=torch.bool),
            depth=torch.zeros(B, T, 6, 6),
            centers=torch.where(
                torch.arange(B * V).view(B, V, 1) > V, torch.nan, reference.centers
            ),
        ),
        context=CONTEXT,
        weights=LossWeights(level1=0, level0=0),
    )
    assert float(found.total) == 0 and found.total.requires_grad
    found.total.backward()
    for given in (prediction.image, prediction.depth):
        assert given is not None and given.grad is not None and not bool(given.grad.any())
    assert {name: int(value) for name, value in found.counts.items()} == {
        "rgb_pixels": 0,
        "rgb_empty": B,
        "depth_pixels": 0,
        "depth_empty": B,
        "depth_without_scale": 1,
    }


def test_every_prediction_is_pulled_but_the_centres():
    prediction, reference = _batch()
    objective(prediction, reference, context=CONTEXT).total.backward()
    assert prediction.centers is not None and prediction.centers.grad is None
    for name in ("level1", "level0", "image", "depth"):
        gradient = getattr(prediction, name).grad
        assert bool(gradient.isfinite().all()) and bool(gradient.any())


@pytest.mark.gpu
def test_the_device_changes_neither_the_terms_nor_the_gradients():
    def on(device: str) -> tuple[dict[str, float], list[torch.Tensor]]:
        values = [
            {name: x.detach().to(device) for name, x in vars(part).items() if x is not None}
            for part in _batch()
        ]
        prediction = Prediction(**{name: x.requires_grad_() for name, x in values[0].items()})
        found = objective(prediction, Reference(**values[1]), context=CONTEXT)
        found.total.backward()
        pulled = [x.grad for x in vars(prediction).values() if x.grad is not None]
        return found.record(), [x.cpu() for x in pulled]

    (ours, gradients), (expected, wanted) = on("cuda"), on("cpu")
    assert ours == pytest.approx(expected, rel=1e-5)
    for one, other in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_wrong_coefficients_are_refused(value):
    with pytest.raises(OptionError, match="loss weight rgb"):
        LossWeights(rgb=value)
