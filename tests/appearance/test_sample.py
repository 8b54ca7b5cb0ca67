"""A random part of the Gaussians that stands for all of them."""

from __future__ import annotations

import numpy as np
import torch
from splat_scene import rough_gaussians

from gvtools.appearance.population import MOST_OPAQUE, NEGLIGIBLE, Sample
from gvtools.appearance.splat.project_kernels import LOGIT, VALUES


def some_values() -> np.ndarray:
    values = rough_gaussians().values
    values[:, LOGIT] = np.linspace(-5, 6, len(values))
    return values


def test_a_negligible_share_leaves_all_as_they_are():
    values = some_values()
    sample = Sample(values, NEGLIGIBLE / 2, rng=np.random.default_rng(0))
    gradients, seen = np.ones((3, VALUES), np.float32), np.array([1, 5, 9])
    assert sample.values is values
    np.testing.assert_array_equal(sample.back(seen, gradients), seen)
    assert (gradients == 1).all()


def test_those_that_are_left_stop_the_light_of_those_that_are_missing():
    values, before = some_values(), some_values()
    sample = Sample(values, 0.3, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(values, before)
    assert 0.62 < len(sample.values) / len(values) < 0.78
    rows = sample.back(
        np.arange(len(sample.values)), np.ones((len(sample.values), VALUES), np.float32)
    )
    assert (np.diff(rows) > 0).all()
    others = np.arange(VALUES) != LOGIT
    np.testing.assert_array_equal(sample.values[:, others], values[rows][:, others])
    opacity, raised = (1 / (1 + np.exp(-each[:, LOGIT])) for each in (values[rows], sample.values))
    np.testing.assert_allclose(raised, np.minimum(opacity / 0.7, MOST_OPAQUE), rtol=1e-4)


def test_gradients_come_back_by_the_chain_rule():
    values, rng = some_values(), np.random.default_rng(1)
    sample = Sample(values, 0.4, rng=rng)
    seen = np.arange(0, len(sample.values), 3)
    by_raised = rng.normal(size=(len(seen), VALUES)).astype(np.float32)
    gradients = by_raised.copy()
    rows = sample.back(seen, gradients)
    logits = torch.from_numpy(values[rows, LOGIT]).double().requires_grad_()
    raised = torch.clamp(torch.sigmoid(logits) / 0.6, max=MOST_OPAQUE)
    (torch.logit(raised) * torch.from_numpy(by_raised[:, LOGIT]).double()).sum().backward()
    assert logits.grad is not None
    assert 0.2 < (logits.grad == 0).double().mean() < 0.8
    np.testing.assert_allclose(gradients[:, LOGIT], logits.grad.numpy(), rtol=1e-2, atol=1e-4)
    others = np.arange(VALUES) != LOGIT
    np.testing.assert_array_equal(gradients[:, others], by_raised[:, others])
