"""gsplat behind the interface of Splat: its arguments, against gsplat's own plain torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gvtools.appearance.splat import gsplat_splatter, project_kernels
from gvtools.appearance.splat.gsplat_splatter import (
    GsplatSplat,
    camera_arguments,
    gaussian_arguments,
    gradient_rows,
    image_of,
    splatter_on,
)
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.errors import OptionError
from gvtools.settings import with_values

SIZE = (48, 36)


def gaussians(count=40):
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
    return Lens.of(pose, K, size=SIZE, near=0.1)


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
        d_camera, Lens.of(d_pose[0].numpy(), np.eye(3), size=SIZE, near=0).numbers[:12]
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


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gsplats_plain_torch_projects_as_splat_does(degree):
    reference = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")
    values = gaussians()
    ours = Splat(values, lens(), degree=degree)
    given = gaussian_arguments(torch.from_numpy(values))
    viewmats, Ks = camera_arguments(lens(), "cpu")
    covars, _ = reference._quat_scale_to_covar_preci(given["quats"], given["scales"])
    _, centers, depths, conics, _ = reference._fully_fused_projection(
        given["means"], covars, viewmats, Ks, *SIZE, eps2d=project_kernels.BLUR, near_plane=0.1
    )
    directions = given["means"] - torch.inverse(viewmats)[0, :3, 3]
    colors = reference._spherical_harmonics(degree, directions, given["colors"])
    theirs = torch.cat(
        [centers[0], conics[0], given["opacities"][:, None], (colors + 0.5).clamp(min=0),
         depths[0][:, None]], dim=1,
    )  # fmt: skip
    assert 10 < len(ours.seen) < len(values)
    columns = slice(project_kernels.X, project_kernels.DEPTH + 1)
    np.testing.assert_allclose(
        ours.projected[ours.seen, columns], theirs.numpy()[ours.seen], rtol=2e-4, atol=2e-4
    )


@pytest.mark.gpu
def test_pictures_and_gradients_are_those_of_the_cpu():
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    values, weight = gaussians(), np.random.default_rng(0).normal(size=(5, *SIZE[::-1]))
    pictures = [kind(values, lens()) for kind in (Splat, GsplatSplat)]
    # Its CUDA kernels leave out what adds less than 1 / 255 of opacity: more in units of depth.
    farthest = values[:, 2].max()
    for channel, (theirs, ours) in enumerate(
        zip(pictures[1].image, pictures[0].image, strict=True)
    ):
        bound = 0.02 * (farthest if channel == 3 else 1)
        np.testing.assert_allclose(theirs, ours, atol=bound)
    dense = []
    for picture in pictures:
        rows, d_camera = picture.backward(weight.astype(np.float32))
        full = np.zeros((len(values), rows.shape[1]), np.float32)
        full[picture.seen] = rows
        dense.append((full, d_camera))
    error = np.linalg.norm(dense[1][0] - dense[0][0]) / np.linalg.norm(dense[0][0])
    assert error < 0.05
