"""LPIPS on a backbone with made-up weights: the plumbing is the published one, no value is."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gvtools.errors import CheckpointError, OptionError, ShapeError
from gvtools.evaluation.lpips_distance import (
    BACKBONES,
    Lpips,
    distance,
    find_weights,
    load_model,
)

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


def pictures(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    image = (rng.random((64, 80, 3)) * 255).astype(np.uint8)
    noise = rng.normal(0, 20, image.shape)
    return image, np.clip(image + noise, 0, 255).astype(np.uint8)


@needs_package
def test_it_is_the_packages_own_forward(alex, monkeypatch):
    import torch

    model = load_model("alex", alex)
    # Imported without torchvision, which need not fit the installed torch, on our layers.
    layers = BACKBONES["alex"].build()
    layers.load_state_dict(model.layers.state_dict())
    models = ModuleType("torchvision.models")
    models.alexnet = lambda **_: SimpleNamespace(features=layers)  # type: ignore[attr-defined]
    torchvision = ModuleType("torchvision")
    torchvision.models = models  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torchvision", torchvision)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    import lpips

    package: Any = lpips.LPIPS(net="alex", pnet_rand=True, verbose=False)
    image, truth = pictures()
    value, spread = distance(model, image, truth)
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
def test_equal_pictures_have_no_distance_and_noise_adds_to_it(alex):
    model = load_model("alex", alex)
    image, _ = pictures()
    rng = np.random.default_rng(1)
    values = [
        distance(model, np.clip(image + rng.normal(0, s, image.shape), 0, 255).astype("u1"), image)
        for s in (0, 5, 40)
    ]
    assert values[0][0] == 0
    assert values[0][0] < values[1][0] < values[2][0]


@pytest.mark.parametrize("net", list(BACKBONES))
def test_backbones_have_the_published_shapes(net):
    """Parameter counts of torchvision's feature layers."""
    count = sum(p.numel() for p in BACKBONES[net].build().parameters())
    assert count == {"vgg": 14_714_688, "alex": 2_469_696}[net]


def test_absent_weights_name_the_file_and_its_place(tmp_path):
    with pytest.raises(CheckpointError, match=r"vgg16-397923af\.pth is absent; download https"):
        Lpips("vgg", folder=tmp_path)
    with pytest.raises(OptionError, match="vgg, alex"):
        Lpips("resnet")


def test_torchs_cache_is_where_no_folder_is_named(tmp_path, monkeypatch, alex):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(CheckpointError, match="--lpips-weights"):
        find_weights("alex")
    (tmp_path / "hub/checkpoints").mkdir(parents=True)
    (tmp_path / "hub/checkpoints" / alex.name).write_bytes(alex.read_bytes())
    assert find_weights("alex").is_file()


def test_another_network_is_never_called_lpips(alex, tmp_path):
    with pytest.raises(CheckpointError, match="SHA-256"):
        Lpips("alex", folder=alex.parent)
    (tmp_path / "weights.pth").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="does not hold the weights"):
        load_model("alex", tmp_path / "weights.pth")
    with pytest.raises(CheckpointError, match="does not hold the weights"):
        load_model("vgg", alex)


@needs_package
def test_shapes_are_checked(alex):
    model = load_model("alex", alex)
    image, truth = pictures()
    wrongs: list[Any] = [truth[:-1], truth.astype(np.float32), truth[..., 0]]
    for wrong in wrongs:
        with pytest.raises(ShapeError):
            distance(model, image, wrong)
    with pytest.raises(ShapeError, match="at least 32"):
        distance(model, image[:20], truth[:20])
