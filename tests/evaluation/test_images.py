"""Figures of pictures against libraries: PSNR, SSIM, LPIPS; pictures that were read otherwise."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from gvtools.errors import CheckpointError, OptionError, ShapeError
from gvtools.evaluation.images import (
    BACKBONES,
    Lpips,
    better_reading,
    image_figures,
    psnr,
    relative_depth_error,
    ssim,
    ssim_map,
)
from gvtools.scenes.scene import Frame


@pytest.fixture
def pair():
    rng = np.random.default_rng(4)
    truth = rng.random((40, 52, 3))
    return np.clip(truth + rng.normal(0, 0.1, truth.shape), 0, 1), truth


@pytest.mark.parametrize("sample", [False, True])
def test_figures_are_scikit_images_and_a_full_mask_changes_nothing(pair, sample):
    image, truth = pair
    expected, similarity = structural_similarity(
        image, truth, gaussian_weights=True, sigma=1.5, use_sample_covariance=sample,
        data_range=1.0, channel_axis=-1, full=True,
    )  # fmt: skip
    ours = ssim_map(image, truth, sample_covariance=sample)
    np.testing.assert_allclose(ours, similarity[5:-5, 5:-5].mean(axis=-1), atol=1e-12)
    for mask in (None, np.ones(truth.shape[:2], bool)):
        assert psnr(image, truth, mask=mask) == pytest.approx(
            peak_signal_noise_ratio(truth, image, data_range=1)
        )
        found = ssim(image, truth, mask=mask, sample_covariance=sample)
        assert found == pytest.approx(expected, abs=1e-12)


def test_psnr_of_a_constant_error_is_its_closed_form():
    truth = np.full((8, 9, 3), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0)
    assert psnr(truth, truth) == float("inf")


def test_bytes_stand_for_255ths(pair):
    image, truth = (np.round(array * 255).astype(np.uint8) for array in pair)
    assert psnr(image, truth) == pytest.approx(psnr(image / 255, truth / 255))
    assert ssim(image, truth / 255) == pytest.approx(ssim(image / 255, truth / 255))
    # float32 is compared in float64.
    single = (truth / 255).astype(np.float32)
    assert psnr(image, single) == pytest.approx(psnr(image / 255, single.astype(np.float64)))


def test_depth_error_is_the_median_over_pixels_with_both():
    truth = np.full((6, 6), 2.0)
    depth = truth * 1.05
    depth[0] = truth[0] * 3
    truth[1], depth[2] = 0, 0
    depth[3, 0], truth[3, 1] = np.nan, np.inf
    assert relative_depth_error(depth, truth) == pytest.approx(0.05)
    first_row = np.zeros((6, 6), bool)
    first_row[0] = True
    assert relative_depth_error(depth, truth, mask=first_row) == pytest.approx(2.0)
    assert relative_depth_error(depth, np.zeros((6, 6))) is None


def test_what_does_not_fit_is_refused():
    image = np.zeros((20, 20, 3))
    with pytest.raises(ShapeError, match="expected equal"):
        psnr(image, image[:-1])
    with pytest.raises(ShapeError, match="int64"):
        psnr(image.astype(np.int64), image)
    with pytest.raises(ShapeError, match="at least 11x11"):
        ssim(image[:10], image[:10])


def test_regions_have_the_figures_of_their_masks():
    rng = np.random.default_rng(6)
    first = (rng.random((40, 50, 3)) * 255).astype(np.uint8)
    second = (rng.random((40, 50, 3)) * 255).astype(np.uint8)
    mask = rng.random((40, 50)) > 0.4
    found = image_figures(first, second, {"all": None, "some": mask, "none": mask & ~mask})
    assert found["all"]["psnr"] == pytest.approx(psnr(first, second))
    assert found["all"]["ssim"] == pytest.approx(ssim(first, second))
    assert found["some"]["psnr"] == pytest.approx(psnr(first, second, mask=mask))
    assert found["some"]["ssim"] == pytest.approx(ssim(first, second, mask=mask))
    assert found["none"] == {"psnr": None, "ssim": None}
    small = image_figures(first[:9], second[:9], {"all": None})
    assert small["all"]["ssim"] is None


RNG = np.random.default_rng(0)


def smooth() -> np.ndarray:
    rgb = RNG.integers(0, 256, (12, 16, 3), np.uint8)
    return np.asarray(cv2.resize(rgb, (160, 120), interpolation=cv2.INTER_CUBIC), np.uint8)


TRUTHS = [smooth() for _ in range(3)]


def noisy(rgb: np.ndarray) -> np.ndarray:
    return (rgb + np.random.default_rng(1).normal(0, 3, rgb.shape)).clip(0, 255).astype(np.uint8)


def linear(rgb: np.ndarray) -> np.ndarray:
    share = rgb / 255
    return np.where(share < 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4) * 255


def enlarged(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(rgb[6:-6, 8:-8], (160, 120), interpolation=cv2.INTER_CUBIC))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rgb: rgb, ""),
        (lambda rgb: rgb[:, ::-1], "mirrored"),
        (lambda rgb: rgb[::-1], "upside down"),
        (lambda rgb: rgb[::-1, ::-1], "turned by 180"),
        (lambda rgb: rgb[..., ::-1], "red and blue"),
        (lambda rgb: 255 - rgb, "negatives"),
        (lambda rgb: rgb[..., :1].repeat(3, 2), "grey, where"),
        (linear, "linear light"),
        (lambda rgb: 16 + rgb * (219 / 255), "another brightness"),
        (lambda rgb: np.roll(rgb, (2, 3), (0, 1)), "shifted (3"),
        (enlarged, "1.11 times as large"),
        (lambda rgb: 0 * rgb, "one colour"),
        (lambda rgb: RNG.integers(0, 9, rgb.shape), ""),
    ],
)
def test_pictures_that_would_fit_if_they_were_read_otherwise(change, said):
    pictures = [change(noisy(rgb)).astype(np.uint8) for rgb in TRUTHS]
    found = better_reading(pictures, [Frame(rgb) for rgb in TRUTHS])
    assert said in found and bool(found) == bool(said)


def test_pictures_of_other_views_and_masked_ones_tell_nothing():
    pictures = [noisy(rgb) for rgb in TRUTHS]
    assert better_reading(pictures[1:] + pictures[:1], [Frame(rgb) for rgb in TRUTHS]) == ""
    nothing = np.zeros((120, 160), bool)
    assert better_reading(pictures, [Frame(rgb, mask=nothing) for rgb in TRUTHS]) == ""


needs_package = pytest.mark.skipif(
    importlib.util.find_spec("lpips") is None, reason="needs the package lpips"
)


@pytest.fixture(scope="module")
def alex(tmp_path_factory):
    """A file with AlexNet's names and shapes and formula weights."""
    import torch

    torch.manual_seed(0)
    backbone = BACKBONES["alex"]
    weights = {f"features.{k}": v for k, v in backbone.build().state_dict().items()}
    weights["classifier.1.weight"] = torch.zeros(1)  # is there in the published file, too
    path = tmp_path_factory.mktemp("weights") / backbone.file
    torch.save(weights, path)
    return path


@pytest.fixture
def take(tmp_path, monkeypatch):
    """Makes a file's content the published weights of a network, and opens that."""

    def opened(net: str, content: bytes) -> Lpips:
        file = f"{net}-{hashlib.sha256(content).hexdigest()[:8]}.pth"
        (tmp_path / file).write_bytes(content)
        monkeypatch.setitem(BACKBONES, net, replace(BACKBONES[net], file=file))
        return Lpips(net, folder=tmp_path)

    return opened


def pictures(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    image = (rng.random((64, 80, 3)) * 255).astype(np.uint8)
    noise = rng.normal(0, 20, image.shape)
    return image, np.clip(image + noise, 0, 255).astype(np.uint8)


@needs_package
def test_it_is_the_packages_own_forward(alex, take, monkeypatch):
    import torch

    lpips = take("alex", alex.read_bytes())
    # Imported without torchvision, which need not fit the installed torch, on our layers.
    layers = BACKBONES["alex"].build()
    layers.load_state_dict(lpips.layers.state_dict())
    models = ModuleType("torchvision.models")
    models.alexnet = lambda **_: SimpleNamespace(features=layers)  # type: ignore[attr-defined]
    torchvision = ModuleType("torchvision")
    torchvision.models = models  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torchvision", torchvision)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    from lpips import LPIPS

    package: Any = LPIPS(net="alex", pnet_rand=True, verbose=False)
    image, truth = pictures()
    value, spread = lpips.distance(image, truth)
    first, second = (
        torch.from_numpy(x).permute(2, 0, 1)[None].float() / 127.5 - 1 for x in (image, truth)
    )
    with torch.no_grad():
        assert value == pytest.approx(float(package(first, second)), rel=1e-5)
        package.spatial = True
        expected = package(first, second)[0, 0].numpy()
    np.testing.assert_allclose(spread, expected, rtol=1e-4, atol=1e-7)
    assert spread.shape == (64, 80)


@needs_package
def test_equal_pictures_have_no_distance_noise_adds_to_it_and_shapes_are_checked(alex, take):
    distance = take("alex", alex.read_bytes()).distance
    image, truth = pictures()
    rng = np.random.default_rng(1)
    values = [
        distance(np.clip(image + rng.normal(0, s, image.shape), 0, 255).astype("u1"), image)[0]
        for s in (0, 5, 40)
    ]
    assert 0 == values[0] < values[1] < values[2]
    wrongs: list[Any] = [truth[:-1], truth.astype(np.float32), truth[..., 0]]
    for wrong in wrongs:
        with pytest.raises(ShapeError):
            distance(image, wrong)
    with pytest.raises(ShapeError, match="at least 32"):
        distance(image[:20], truth[:20])


@pytest.mark.parametrize(("net", "count"), [("vgg", 14_714_688), ("alex", 2_469_696)])
def test_backbones_have_the_parameters_of_torchvisions(net, count):
    assert sum(p.numel() for p in BACKBONES[net].build().parameters()) == count


def test_absent_weights_name_the_file_and_its_place(tmp_path, monkeypatch, alex):
    with pytest.raises(CheckpointError, match=r"vgg16-397923af\.pth is absent; download https"):
        Lpips("vgg", folder=tmp_path)
    with pytest.raises(OptionError, match="vgg, alex"):
        Lpips("resnet")
    # Without a folder torch's cache is looked at.
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(CheckpointError, match="--lpips-weights"):
        Lpips("alex")
    (tmp_path / "hub/checkpoints").mkdir(parents=True)
    (tmp_path / "hub/checkpoints" / alex.name).write_bytes(alex.read_bytes())
    with pytest.raises(CheckpointError, match="SHA-256"):
        Lpips("alex")
