"""What the stereo takes from kornia, against scipy: pixel centres, borders and conventions."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import map_coordinates, uniform_filter
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.depth.stereo.matching import build_pyramid
from gvtools.depth.stereo.matching_torch import bilinear, window_mean
from gvtools.poses.dense_adjustment import _rigid

RNG = np.random.default_rng(5)


def test_values_between_pixels_are_scipys_with_centres_at_a_half() -> None:
    picture = RNG.random((40, 60)).astype(np.float32)
    padded = np.full((45, 70), np.nan, np.float32)
    padded[:40, :60] = picture
    x, y = RNG.uniform(-5, 65, (2, 30, 50)).astype(np.float32)
    found = bilinear(torch.from_numpy(padded), [60, 40], torch.from_numpy(x), torch.from_numpy(y))
    expected = map_coordinates(picture, [y - 0.5, x - 0.5], order=1, mode="nearest")
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_window_means_are_scipys_with_the_border_repeated() -> None:
    images = RNG.random((3, 20, 31)).astype(np.float32)
    expected = [uniform_filter(image, 5, mode="nearest") for image in images]
    np.testing.assert_allclose(window_mean(torch.from_numpy(images), 5), expected, atol=1e-6)
    np.testing.assert_allclose(window_mean(torch.from_numpy(images[0]), 5), expected[0], atol=1e-6)


def test_rigid_motions_are_scipys() -> None:
    motion = RNG.normal(size=(5, 6)) * np.array([3, 1, 1e-4, 1e-9, 0])[:, None]
    found = _rigid(motion)
    np.testing.assert_allclose(
        found[:, :3, :3], Rotation.from_rotvec(motion[:, :3]).as_matrix(), atol=1e-14
    )
    np.testing.assert_array_equal(found[:, :3, 3], motion[:, 3:])
    np.testing.assert_array_equal(found[:, 3], np.tile([0, 0, 0, 1], (5, 1)))


def test_luminance_is_that_of_bt601() -> None:
    rgb = RNG.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    K = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])
    camera = Cameras(K[None], np.eye(4)[None], np.array([32]), np.array([24]), ("a",))
    found = build_pyramid(rgb, camera, max_side=100, levels=1).images[0]
    np.testing.assert_allclose(found, rgb / 255 @ [0.299, 0.587, 0.114], atol=1e-6)
