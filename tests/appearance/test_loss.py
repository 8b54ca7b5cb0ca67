"""The loss between pictures against kornia and autograd, and Adam on rows against torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.metrics import ssim
from torch.nn.functional import huber_loss

from gvtools.appearance import loss
from gvtools.appearance.loss import EDGE, LEAST_ALPHA, SOFT, add_bending
from gvtools.appearance.splat.project_kernels import VALUES

HEIGHT, WIDTH, SHARE = 30, 37, 0.2


@pytest.fixture(scope="module")
def pictures():
    """Picture, target, and weights that are 0 where a window leaves the picture."""
    rng = np.random.default_rng(0)
    target = rng.uniform(0, 1, (3, HEIGHT, WIDTH)).astype(np.float32)
    picture = (0.6 * target + 0.4 * rng.uniform(0, 1, target.shape)).astype(np.float32)
    weight = np.zeros((HEIGHT, WIDTH), np.float32)
    inner = (slice(loss.HALF, -loss.HALF),) * 2
    weight[inner] = rng.uniform(0, 1, weight[inner].shape)
    return picture, target, weight


def gradient_of(pictures, first: int = 0, last: int = 3) -> np.ndarray:
    picture, target, weight = pictures
    gradient = np.zeros_like(picture)
    loss.loss_gradient(first, last, picture, target, weight, SHARE, gradient)
    return gradient


def reference_loss(picture: torch.Tensor, target, weight) -> torch.Tensor:
    """By kornia: the weighted mean over all pixels and channels."""
    theirs = torch.from_numpy(target).double()[None]
    similar = ssim(picture[None], theirs, loss.WINDOW)[0]
    each = (1 - SHARE) * (picture - theirs[0]).abs() + SHARE * (1 - similar)
    return (each * torch.from_numpy(weight).double()).mean()


def test_the_gradient_is_that_of_autograd_through_kornias_loss(pictures):
    picture, target, weight = pictures
    theirs = torch.from_numpy(picture).double().requires_grad_()
    reference_loss(theirs, target, weight).backward()
    assert theirs.grad is not None
    scale = float(theirs.grad.abs().max())
    gradient = gradient_of(pictures)
    np.testing.assert_allclose(gradient, theirs.grad.numpy(), atol=1e-4 * scale, rtol=1e-3)


def test_the_gradient_is_rounded_as_written(pictures):
    """So that it cannot depend on how a compiler orders sums, or on where arrays lie."""
    picture, target, weight = pictures
    interpreted = np.zeros_like(picture)
    loss.loss_gradient.py_func(0, 3, picture, target, weight, SHARE, interpreted)
    np.testing.assert_array_equal(gradient_of(pictures), interpreted)
    compiled, by_hand = np.empty_like(weight), np.empty_like(weight)
    work = np.empty(WIDTH + loss.WINDOW + 1, np.float32)
    loss.blur(picture[0], compiled, work)
    loss.blur.py_func(picture[0], by_hand, work)
    np.testing.assert_array_equal(compiled, by_hand)


@pytest.mark.parametrize("columns", [VALUES, 14])
def test_rows_move_as_by_torchs_adam_and_the_others_stay(columns):
    rng = np.random.default_rng(1)
    values = rng.normal(size=(9, VALUES)).astype(np.float32)
    before, moments = values.copy(), np.zeros((2, 9, VALUES), np.float32)
    rows, rates = np.array([1, 4, 5, 8]), rng.uniform(1e-3, 1e-2, VALUES).astype(np.float32)
    widths = rng.uniform(0.1, 3, 9).astype(np.float32)
    # Adam's steps do not depend on where the values are, so steps of length 1 tell all others.
    unit = torch.zeros(4, columns, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([unit], lr=1.0, betas=(0.9, 0.999), eps=1e-15)
    for step in range(1, 6):
        gradients = rng.normal(size=(4, columns)).astype(np.float32)
        unit.grad = torch.from_numpy(gradients).double()
        adam.step()
        for first, last in ((0, 1), (1, 4)):
            loss.adam_rows(
                first, last, rows, gradients, values, moments, rates, widths, step
            )  # fmt: skip
    length = np.repeat(rates[None, :columns], 4, axis=0)
    length[:, :3] *= widths[rows, None]
    expected = before[rows, :columns] + length * unit.detach().numpy()
    np.testing.assert_allclose(values[rows, :columns], expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(values[rows, columns:], before[rows, columns:])
    others = np.setdiff1d(np.arange(9), rows)
    np.testing.assert_array_equal(values[others], before[others])
    assert not moments[:, others].any()


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


def test_an_empty_picture_has_no_gradient():
    image = np.zeros((5, HEIGHT, WIDTH), np.float32)
    gradient = np.zeros_like(image)
    add_bending(image, image[:3], gradient, weight=1.0)
    assert not gradient.any()
