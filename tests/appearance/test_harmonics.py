"""Gaussians in other axes, and with exposures in their colours."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference_gaussians import harmonics as reference
from scipy.spatial.transform import Rotation
from splat_scene import HEIGHT, NEAR, WIDTH, K, pose, rough_gaussians, walk

from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.harmonics import exposed, harmonics, harmonics_turned, turned
from gvtools.appearance.splat.project_kernels import LOGIT, SH
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame

AXES = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()


@pytest.fixture(scope="module")
def coloured():
    """Anisotropic Gaussians whose colours depend on the direction."""
    values = rough_gaussians().values.copy()
    rng = np.random.default_rng(3)
    values[:, 3:6] += rng.normal(scale=0.5, size=(len(values), 3))
    values[:, 6:10] = rng.normal(size=(len(values), 4))
    values[:, LOGIT] = 0
    values[:, SH + 3 :] += rng.normal(scale=0.1, size=(len(values), values.shape[1] - SH - 3))
    return values


def picture(values: np.ndarray, cam_from_local: np.ndarray) -> np.ndarray:
    lens = Lens.of(cam_from_local, K, size=(WIDTH, HEIGHT), near=NEAR)
    return Splat(np.ascontiguousarray(values, np.float32), lens).image


def test_harmonics_are_those_of_splat_files():
    drawn = np.random.default_rng(0).normal(size=(50, 3))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    np.testing.assert_allclose(harmonics(drawn), reference(torch.from_numpy(drawn)), atol=1e-12)


def test_harmonics_turn_within_their_degree():
    matrix = harmonics_turned(AXES)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(9), atol=1e-12)
    outside = np.ones((9, 9), bool)
    for first, last in ((0, 1), (1, 4), (4, 9)):
        outside[first:last, first:last] = False
    np.testing.assert_allclose(matrix[outside], 0, atol=1e-12)


def test_turned_gaussians_give_the_same_picture(coloured):
    camera = pose(0.3)
    turn = np.eye(4)
    turn[:3, :3] = AXES
    before = picture(coloured, camera)
    assert before[4].mean() > 0.3
    after = picture(turned(coloured, AXES), camera @ turn.T)
    np.testing.assert_allclose(after, before, atol=2e-4)


def test_exposed_gaussians_are_as_bright_as_each_camera_has_them(coloured):
    poses = walk(9)
    gains = np.outer(np.linspace(-0.15, 0.15, 9), [1.0, 0.6, -1.0])
    exposures = Exposures(poses, gains, depth=3.0)
    frame = LocalFrame.at([100.0, -20.0, 5.0], AXES)
    count = len(poses)
    cameras = Cameras(
        np.tile(K, (count, 1, 1)), frame.cam_from_world(poses),
        np.full(count, WIDTH), np.full(count, HEIGHT), tuple(map(str, range(count))),
    )  # fmt: skip
    values = coloured.copy()
    # Colours in the middle, which no gain drives out of range.
    values[:, SH + 3 :] *= 0.3
    given = Gaussians(values, frame=frame)
    result = exposed(given, exposures, cameras)
    np.testing.assert_array_equal(result.values[:, :SH], values[:, :SH])
    assert result.frame is frame
    errors, without = [], []
    for each in poses:
        plain = picture(values, each)[:3]
        bright = plain * exposures.at(each)[:, None, None]
        errors.append(np.square(picture(result.values, each)[:3] - bright).mean())
        without.append(np.square(plain - bright).mean())
    assert np.mean(errors) < np.mean(without) / 3
