"""The bending of surfaces against autograd, and what it does to depth without texture."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn.functional import huber_loss

from gvtools.appearance.loss import EDGE, LEAST_ALPHA, SOFT, add_bending

HEIGHT, WIDTH = 17, 23


@pytest.fixture
def scene():
    """Image (depth times alpha and alpha in its last two channels) and its photograph."""
    rng = np.random.default_rng(0)
    depth = 2 + 0.01 * rng.normal(size=(HEIGHT, WIDTH))
    alpha = rng.uniform(0.7, 1, depth.shape)
    alpha[4:6, 5:9] = 0.2
    color = rng.uniform(0, 0.2, (3, HEIGHT, WIDTH))
    return np.concatenate([color, [depth * alpha, alpha]]).astype(np.float32), color.astype(
        np.float32
    )


def reference(image: torch.Tensor, target: torch.Tensor, median: float) -> torch.Tensor:
    """Loss by whole arrays; the median is a number, as in the kernel."""
    solid = image[4] > LEAST_ALPHA
    inverse = median * image[4] / image[3]
    total = torch.zeros((), dtype=torch.float64)
    for axis in (0, 1):
        size = image.shape[1 + axis] - 2
        before, here, after = (inverse.narrow(axis, k, size) for k in range(3))
        there = torch.stack([solid.narrow(axis, k, size) for k in range(3)]).all(0)
        colors = [target.narrow(1 + axis, k, size) for k in range(3)]
        change = (colors[0] - colors[1]).abs().sum(0) + (colors[2] - colors[1]).abs().sum(0)
        bend = (before - 2 * here + after)[there]
        each = huber_loss(bend / SOFT, torch.zeros_like(bend), reduction="none") * SOFT
        total = total + (each * torch.exp(-EDGE / 3 * change[there])).sum()
    return total


def test_its_gradient_is_that_of_autograd(scene):
    image, target = scene
    gradient = np.ones_like(image)
    add_bending(image, target, gradient, weight=0.5)
    # The kernel takes the median of every fourth pixel.
    some = image[3:, ::4, ::4]
    median = float(np.median((some[0] / some[1])[some[1] > LEAST_ALPHA]))
    theirs = torch.from_numpy(image).double().requires_grad_()
    (0.5 * reference(theirs, torch.from_numpy(target).double(), median)).backward()
    assert theirs.grad is not None
    scale = float(theirs.grad.abs().max())
    assert scale > 0
    np.testing.assert_allclose(gradient - 1, theirs.grad.numpy(), atol=1e-3 * scale)


def test_a_plane_does_not_bend():
    x = np.arange(WIDTH) + np.zeros((HEIGHT, 1))
    alpha = np.full((HEIGHT, WIDTH), 0.9)
    image = np.stack([*np.zeros((3, HEIGHT, WIDTH)), alpha / (0.5 + 0.01 * x), alpha])
    gradient = np.zeros((5, HEIGHT, WIDTH), np.float32)
    add_bending(image.astype(np.float32), gradient[:3].copy(), gradient, weight=1.0)
    assert np.abs(gradient).max() < 1e-3


@pytest.mark.parametrize("contrast", [0.0, 1.0])
def test_a_step_pulls_less_where_the_photograph_has_an_edge(contrast):
    depth = np.where(np.arange(WIDTH) < 10, 1.0, 2.0) + np.zeros((HEIGHT, 1))
    target = np.zeros((3, HEIGHT, WIDTH), np.float32)
    target[:, :, 10:] = contrast
    image = np.concatenate([target, [depth, np.ones_like(depth)]]).astype(np.float32)
    gradient = np.zeros_like(image)
    add_bending(image, target, gradient, weight=1.0)
    largest = float(np.abs(gradient[3]).max())
    full = 3 * np.median(depth)
    assert largest == pytest.approx(full * math.exp(-EDGE * contrast), rel=0.7)


def test_an_empty_picture_has_no_gradient():
    image = np.zeros((5, HEIGHT, WIDTH), np.float32)
    gradient = np.zeros_like(image)
    add_bending(image, image[:3], gradient, weight=1.0)
    assert not gradient.any()
