"""Splatting of Gaussians and its gradients, against plain torch and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference_gaussians import reference_splat

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat import gsplat_splatter, project_kernels
from gvtools.appearance.splat.gsplat_splatter import (
    GsplatSplat,
    gradient_rows,
    image_of,
    splatter_on,
)
from gvtools.appearance.splat.project_kernels import LOGIT
from gvtools.appearance.splat.splat import Lens, Splat, median_depth, splat
from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.settings import with_values


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


SIZE = 45, 37
K = np.array([[40.0, 0, 22.0], [0, 40.0, 19.0], [0, 0, 1]])
LENS = Lens.of(np.eye(4), K, size=SIZE, near=0.05)
CAMERA = Cameras(K[None], np.eye(4)[None], np.array([45]), np.array([37]), ("one",))


def sheets(*depths_and_alphas):
    """Gaussians before the camera, each as wide as the picture."""
    depths, alphas = np.array(depths_and_alphas).T
    centers = np.stack([np.zeros_like(depths), np.zeros_like(depths), depths], axis=1)
    sheet = Gaussians.at(centers, np.full((len(depths), 3), 90), sizes=100 * depths)
    sheet.values[:, LOGIT] = np.log(alphas / (1 - alphas))
    return sheet


def test_each_pixel_has_the_gaussian_at_which_half_of_the_light_is_stopped():
    rng = np.random.default_rng(3)
    centers = np.stack([*rng.uniform(-1, 1, (2, 60)), rng.uniform(1, 3, 60)], axis=1)
    cloud = Gaussians.at(centers, np.full((60, 3), 90), sizes=rng.uniform(0.05, 0.15, 60))
    cloud.values[:, LOGIT] = rng.uniform(-1, 3, 60)
    found = median_depth(Splat(cloud.values, LENS))
    assert 0.3 < (found > 0).mean() < 0.99
    depths = np.unique(found[found > 0])
    assert len(depths) > 10
    place = centers[:, 2].astype(np.float32)
    for depth in depths:
        here = found == depth
        before = Splat(cloud.values[place < depth - 1e-5], LENS).image[4]
        with_it = Splat(cloud.values[place < depth + 1e-5], LENS).image[4]
        assert before[here].max() < 0.501 and with_it[here].min() > 0.499
    np.testing.assert_array_equal(found == 0, Splat(cloud.values, LENS).image[4] <= 0.5)


def test_fog_before_a_surface_does_not_count():
    values = sheets((1.0, 0.3), (3.0, 0.9)).values
    np.testing.assert_allclose(median_depth(Splat(values, LENS)), 3.0, rtol=1e-5)
    _, _, _, weighted, alpha = Splat(values, LENS).image
    assert (weighted / alpha).max() < 2.4


def test_what_is_too_faint_has_no_depth():
    assert not median_depth(Splat(sheets((1.0, 0.2), (3.0, 0.3)).values, LENS)).any()


@pytest.mark.parametrize(
    ("depths", "expected"), [((2.0, 8.0), 2.0), ((5.0, 2.0, 3.0), 3.0), ((None, 4.0), 4.0)]
)
def test_several_fits_have_the_median_of_those_that_show_a_surface(depths, expected):
    first, *others = (sheets((depth or 1.0, 0.9 if depth else 0.1)) for depth in depths)
    found = Appearance(first, 0.05, others=tuple(others)).depth(CAMERA)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5)


PICTURE = (48, 36)


def flat_gaussians(count=40):
    """(N, VALUES) Gaussians in front of the camera of ``lens``, some beyond its picture."""
    g = torch.Generator().manual_seed(0)
    values = torch.randn(count, project_kernels.VALUES, generator=g) * 0.3
    values[:, :3] *= torch.tensor([6.0, 4.0, 2.0])
    values[:, 2] += 4
    values[:, 3:6] -= 2
    values[:, 6] += 1
    values[:, 10] += 1
    return values.numpy()


def lens():
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.96, 0, 0.28], [0, 1, 0], [-0.28, 0, 0.96]])
    pose[:3, 3] = [-0.3, 0.1, 0.2]
    K = np.array([[43.0, 0, 25], [0, 46, 17], [0, 0, 1]])
    return Lens.of(pose, K, size=PICTURE, near=0.1)


def test_pixels_and_gradients_are_put_in_the_order_of_splat():
    colors, alphas = torch.rand(1, 36, 48, 4), torch.rand(1, 36, 48, 1)
    image = image_of(colors, alphas)
    assert image.shape == (5, 36, 48)
    assert torch.equal(image[:, 7, 11], torch.cat([colors[0, 7, 11], alphas[0, 7, 11]]))
    d_values, d_centers = torch.rand(6, project_kernels.VALUES), torch.rand(1, 6, 2)
    d_pose, seen = torch.rand(1, 4, 4), np.array([1, 4])
    rows, d_camera = gradient_rows(d_values, d_centers, d_pose, seen=seen)
    np.testing.assert_array_equal(rows[1, :-2], d_values[4])
    np.testing.assert_array_equal(rows[1, -2:], d_centers[0, 4])
    # As Lens has rotation and translation.
    assert np.array_equal(
        d_camera, Lens.of(d_pose[0].numpy(), np.eye(3), size=PICTURE, near=0).numbers[:12]
    )


def test_the_splatter_is_that_of_the_device(monkeypatch):
    for installed in (False, True):
        monkeypatch.setattr(gsplat_splatter, "gsplat_installed", lambda found=installed: found)
        assert splatter_on("cpu") is Splat
        assert splatter_on("cuda") is (GsplatSplat if installed else Splat)


def test_without_gsplat_cuda_is_refused_unless_nothing_is_fitted(monkeypatch):
    from pipelines.reconstruction import prepare
    from pipelines.reconstruction.settings import RunSettings

    monkeypatch.setattr(prepare, "_cuda", lambda: True)
    monkeypatch.setattr(gsplat_splatter, "gsplat_installed", lambda: False)
    config = with_values(RunSettings(), {"device": "cuda"})
    with pytest.raises(OptionError, match=r"gsplat.*gvtools\[cuda\].*--refine 0"):
        prepare._on_device(config)
    assert prepare._on_device(with_values(config, {"refine.seconds": 0})).splat.device == "cuda"
    monkeypatch.setattr(gsplat_splatter, "gsplat_installed", lambda: True)
    assert prepare._on_device(config).device == "cuda"


@pytest.mark.gpu
def test_pictures_and_gradients_are_those_of_the_cpu():
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    values, weight = flat_gaussians(), np.random.default_rng(0).normal(size=(5, *PICTURE[::-1]))
    pictures = [kind(values, lens()) for kind in (Splat, GsplatSplat)]
    # Its CUDA kernels leave out what adds less than 1 / 255 of opacity: more in units of depth.
    bounds = np.array([0.02, 0.02, 0.02, 0.02 * values[:, 2].max(), 0.02])[:, None, None]
    assert (np.abs(pictures[1].image - pictures[0].image) <= bounds).all()
    dense = []
    for picture in pictures:
        rows, d_camera = picture.backward(weight.astype(np.float32))
        full = np.zeros((len(values), rows.shape[1]), np.float32)
        full[picture.seen] = rows
        dense.append((full, d_camera))
    error = np.linalg.norm(dense[1][0] - dense[0][0]) / np.linalg.norm(dense[0][0])
    assert error < 0.05
