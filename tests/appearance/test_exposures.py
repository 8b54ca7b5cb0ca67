"""Exposures of cameras between photographs."""

from __future__ import annotations

import numpy as np
import pytest
from splat_scene import HEIGHT, WIDTH, K, pose, rough_gaussians

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.camera_corrections import Exposures
from gvtools.cameras import Cameras
from gvtools.errors import MemoryFileError


def along(*places: float) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, 0, 3] = [-place for place in places]
    return poses


def smooth() -> Exposures:
    """Red brightens along a path of one unit, blue darkens."""
    places = np.linspace(0, 1, 11)
    gains = np.outer(places - places.mean(), [0.2, 0.0, -0.2])
    return Exposures(along(*places), gains, depth=1.0)


def test_a_camera_between_photographs_is_exposed_like_them():
    exposures = smooth()
    assert exposures.shrinkage > 0.9
    gain = exposures.at(along(0.75)[0])
    np.testing.assert_allclose(np.log(gain), [0.05, 0, -0.05], atol=0.01)


def test_exposures_that_neighbours_do_not_share_tell_nothing():
    places = np.linspace(0, 1, 12)
    gains = np.repeat(np.tile([0.1, -0.1], 6)[:, None], 3, axis=1)
    exposures = Exposures(along(*places), gains, depth=1.0)
    assert exposures.shrinkage == 0
    np.testing.assert_array_equal(exposures.at(along(0.5)[0]), 1)


def test_equal_exposures_and_a_single_photograph_change_nothing():
    for count in (1, 5):
        same = Exposures(along(*np.linspace(0, 1, count)), np.zeros((count, 3)), depth=1.0)
        np.testing.assert_array_equal(same.at(along(0.3)[0]), 1)


def test_pictures_are_exposed_and_kept_so(tmp_path):
    camera = Cameras(K[None], pose(0.0)[None], np.array([WIDTH]), np.array([HEIGHT]), ("one",))
    exposures = Exposures(np.stack([pose(0.0), pose(0.05)]), np.full((2, 3), [-0.2, 0.1, 0]), 2.0)
    # Two alike photographs predict each other.
    assert exposures.shrinkage == 1
    plain = Appearance(rough_gaussians(), 0.05)
    exposed = Appearance(plain.gaussians, 0.05, exposures=exposures)
    dark, usual = exposed.picture(camera), plain.picture(camera)
    np.testing.assert_allclose(dark.rgb[..., 0], usual.rgb[..., 0] * np.exp(-0.2), rtol=1e-5)
    np.testing.assert_allclose(dark.rgb[..., 1], np.minimum(usual.rgb[..., 1] * np.exp(0.1), 1),
                               rtol=1e-5)  # fmt: skip
    np.testing.assert_array_equal(dark.alpha, usual.alpha)
    with (tmp_path / "a.npz").open("wb") as file:
        np.savez(file, **exposed.arrays())
    again = Appearance.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(again.picture(camera).rgb, dark.rgb)


def test_a_file_with_exposures_of_other_views_is_refused(tmp_path):
    exposures = Exposures(np.stack([pose(0.0), pose(0.05)]), np.zeros((1, 3)), 2.0)
    wrong = Appearance(rough_gaussians(), 0.05, exposures=exposures)
    with (tmp_path / "a.npz").open("wb") as file:
        np.savez(file, **wrong.arrays())
    with pytest.raises(MemoryFileError, match="exposures"):
        Appearance.load(tmp_path / "a.npz")
