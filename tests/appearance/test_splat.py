"""Splatting of Gaussians and its gradients, against plain torch and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference_gaussians import reference_splat

from gvtools.appearance.splat.splat import Lens, Splat, splat


def gaussians(count, *, seed=0, dtype=torch.float64, spread=1.0):
    """Random Gaussians about 4 units before a camera at the origin."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    positions = normal(count, 3) * torch.tensor([0.8, 0.5, 0.7]) * spread
    positions[:, 2] += 4
    parts = [positions, -2.0 + 0.4 * normal(count, 3), normal(count, 4), normal(count, 1) + 1.0,
             0.3 * normal(count, 27)]  # fmt: skip
    return torch.cat(parts, 1).to(dtype)


def camera(width, height, dtype=torch.float64):
    angle = torch.tensor(0.1)
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0], pose[0, 2] = angle.cos(), angle.sin()
    pose[2, 0], pose[2, 2] = -angle.sin(), angle.cos()
    pose[:3, 3] = torch.tensor([-0.3, 0.1, 0.2])
    K = torch.tensor([[0.9 * width, 0, 0.52 * width], [0, 0.95 * width, 0.47 * height], [0, 0, 1]])
    return pose.to(dtype), K.to(dtype)


@pytest.mark.parametrize(("degree", "size"), [(0, (31, 18)), (1, (16, 16)), (2, (40, 33))])
def test_pictures_are_those_of_plain_torch(degree, size):
    values, (pose, K) = gaussians(60), camera(*size)
    image = splat(values, cam_from_world=pose, K=K, size=size, near=0.1, degree=degree)
    expected = reference_splat(values, pose, K, size=size, degree=degree)
    assert expected[4].max() > 0.9
    torch.testing.assert_close(image, expected, rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_gradients_are_those_of_plain_torch(dtype, spread):
    size = (29, 23)
    values = gaussians(50, seed=3, spread=spread)
    pose, K = camera(*size)
    weight = torch.randn(5, 23, 29, generator=torch.Generator().manual_seed(1), dtype=dtype)

    def gradients(function, kind):
        v, p = values.to(kind).requires_grad_(), pose.to(kind).requires_grad_()
        (function(v, p) * weight.to(kind)).sum().backward()
        return v.grad.double(), p.grad.double()[:3]

    ours = gradients(
        lambda v, p: splat(v, cam_from_world=p, K=K.to(dtype), size=size, near=0.1), dtype
    )
    theirs = gradients(lambda v, p: reference_splat(v, p, K, size=size), torch.float64)
    groups = {"positions": slice(0, 3), "scales": slice(3, 6), "rotations": slice(6, 10),
              "opacities": slice(10, 11), "colours": slice(11, 38)}  # fmt: skip
    for name, part in groups.items():
        error = (ours[0][:, part] - theirs[0][:, part]).norm() / theirs[0][:, part].norm()
        assert error < 0.01, name
    assert (ours[1] - theirs[1]).norm() / theirs[1].norm() < 0.01


def test_gradients_are_those_of_finite_differences():
    size = (17, 12)
    values = gaussians(6, seed=5).requires_grad_()
    pose, K = camera(*size)
    pose.requires_grad_()
    torch.autograd.gradcheck(
        lambda v, p: splat(v, cam_from_world=p, K=K, size=size, near=0.1),
        (values, pose), eps=1e-6, atol=3e-3, rtol=1e-2, nondet_tol=1e-9,
    )  # fmt: skip


def test_means_agree_with_finite_differences_to_one_per_cent_at_the_cut_off():
    # Faint Gaussians: most of their pixels lie near alpha = 1 / 255, where a hard end would jump.
    size = (48, 48)
    values = gaussians(40, seed=7)
    values[:, 10] = -4.0
    pose, K = camera(*size)
    target = torch.rand(3, 48, 48, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def loss(v):
        image = splat(v, cam_from_world=pose, K=K, size=size, near=0.1)
        return ((image[:3] - target) ** 2).sum()

    v = values.clone().requires_grad_()
    loss(v).backward()
    direction = torch.zeros_like(values)
    direction[:, :3] = v.grad[:, :3].sign()
    step = 1e-4
    numeric = (loss(values + step * direction) - loss(values - step * direction)) / (2 * step)
    analytic = (v.grad * direction).sum()
    assert abs(numeric / analytic - 1) < 0.01


def test_what_is_behind_or_beside_the_camera_is_not_drawn():
    values = gaussians(20).numpy()
    values[:10, 2] = -3
    values[10:, 0] = 50
    pose, K = camera(32, 24)
    lens = Lens.of(pose.numpy(), K.numpy(), size=(32, 24), near=0.1, dtype=np.float64)
    picture = Splat(values, lens)
    assert len(picture.seen) == 0
    assert not picture.image.any()
    rows, d_camera = picture.backward(np.ones_like(picture.image))
    assert len(rows) == 0
    assert not d_camera.any()


def test_results_do_not_depend_on_the_number_of_threads():
    import numba

    values = gaussians(400, dtype=torch.float32).numpy()
    pose, K = camera(70, 50)
    lens = Lens.of(pose.numpy(), K.numpy(), size=(70, 50), near=0.1)
    results = []
    before = numba.get_num_threads()
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            picture = Splat(values, lens)
            results.append((picture.image, *picture.backward(np.ones_like(picture.image))))
    finally:
        numba.set_num_threads(before)
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)
