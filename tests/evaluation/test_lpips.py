"""LPIPS on a backbone with made-up weights: the plumbing is the published one, no value is."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gvtools.errors import CheckpointError, OptionError, ShapeError
from gvtools.evaluation.lpips_distance import BACKBONES, Lpips

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


def test_another_network_is_never_called_lpips(alex, take):
    for net, content in (("alex", b"nothing"), ("vgg", alex.read_bytes())):
        with pytest.raises(CheckpointError, match="does not hold the weights"):
            take(net, content)
