"""Refinement of poses: back to the truth where they are off, untouched where they are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splat_scene import (
    HEIGHT,
    WIDTH,
    K,
    photographs,
    picture,
    pose,
    pose_errors,
    rough_gaussians,
    walk,
)

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.camera_corrections import CameraCorrections, Exposures
from gvtools.appearance.fit import VALIDATION_ENDS, Fit, validation_rows
from gvtools.appearance.fit_options import FitOptions
from gvtools.appearance.population import from_depth
from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.poses.motions import move_pose
from gvtools.poses.refinement import comparable, prediction_error

COUNT = 8
FRAME = LocalFrame.at()


@pytest.fixture(scope="module")
def truth():
    return walk(COUNT)


@pytest.fixture(scope="module")
def views(truth):
    return photographs(truth, depth=True)


@pytest.fixture(scope="module")
def gaussians(views):
    """Fitted from the true poses."""
    fit = Fit(rough_gaussians(), views, options=FitOptions(steps=200, poses=False))
    fit.run()
    return fit.gaussians


def given(views, motions):
    """The views with poses that are off by some motions."""
    return [
        replace(view, cam_from_local=move_pose(view.cam_from_local, motion))
        for view, motion in zip(views, motions, strict=True)
    ]


def test_poses_that_are_off_come_back_nearer_to_the_truth(views, truth):
    rng = np.random.default_rng(1)
    motions = rng.normal(0, [0.03] * 3 + [0.01] * 3, (COUNT, 6))
    off = given(views, motions)
    fit = Fit(from_depth(off, frame=FRAME, seed=0, most=1500), off, options=FitOptions(steps=300))
    fit.run()
    before = pose_errors(np.stack([view.cam_from_local for view in off]), truth)
    after = pose_errors(fit.cameras.poses(), truth)
    assert fit.cameras.with_poses
    assert after[0] < 0.7 * before[0]
    assert after[1] < 0.7 * before[1]
    assert "scene units" in fit.cameras.summary()


def test_exact_poses_are_given_back_to_the_bit(views, truth):
    fit = Fit(from_depth(views, frame=FRAME, seed=0, most=1500), views,
              options=FitOptions(steps=60))  # fmt: skip
    fit.step(0.0)
    assert fit.cameras.with_poses
    assert (fit.cameras.poses() != truth).any()
    fit.run()
    assert not fit.cameras.with_poses
    np.testing.assert_array_equal(fit.cameras.poses(), truth)
    np.testing.assert_array_equal(fit.cameras.corrected(pose(0.3)), pose(0.3))


@pytest.mark.parametrize("depth", [True, False])
def test_poses_are_refined_only_where_asked_for_and_depth_is_recorded(views, truth, depth):
    some = views if depth else [replace(views[0], depth=None), *views[1:]]
    fit = Fit(rough_gaussians(), some, options=FitOptions(steps=100, poses=not depth))
    fit.step(0.0)
    assert not fit.cameras.with_poses
    np.testing.assert_array_equal(fit.cameras.poses(), truth)


@pytest.mark.parametrize("alike", [True, False])
def test_neighbours_corrections_are_taken_only_if_validation_gains(views, truth, gaussians, alike):
    (held,) = validation_rows(COUNT)
    motions = np.zeros((COUNT, 6))
    motions[:, 0] = 0.06
    motions[[0, 1, 7], 0] = -0.1
    if not alike:
        motions[held] = 0
    off = given(views, motions)
    fit = Fit(gaussians, off, options=FitOptions())
    # As if the fit had found the errors of all views but the one held out.
    fit.cameras.twists[:, 0] = -motions[:, 0] / fit.cameras.depth
    fit.cameras.twists[held] = 0
    before = fit.cameras.given[held]
    near = fit.cameras.like_neighbours(held, but=[held])
    fit.step(VALIDATION_ENDS)
    assert fit.cameras.with_poses
    assert fit.cameras.spread == alike
    taken = near if alike else before
    np.testing.assert_allclose(
        fit.predicted[held].rgb, picture(gaussians, taken).rgb, atol=1e-3, rtol=0
    )
    other = off[held].cam_from_local
    error = np.linalg.norm(fit.cameras.corrected(other)[:3, 3] - truth[held][:3, 3])
    assert error < 0.02
    assert alike or np.array_equal(fit.cameras.corrected(other), other)


def test_views_that_do_not_overlap_predict_nothing(views):
    away = np.stack([pose(0.0)] * 3)
    away[1, :3, 3] = [-900, 0, 0]
    away[2, :3, 3] = [900, 0, 0]
    back_to_back = np.stack([pose(0.0), np.diag([-1.0, 1.0, -1.0, 1.0])])
    assert np.isnan(prediction_error(comparable(views[:2]), back_to_back))
    assert np.isnan(prediction_error(comparable(views[:3]), away))


def test_corrections_have_mean_zero_and_a_limit(truth):
    cameras = CameraCorrections(truth, depth=2.0, with_poses=True, exposure=True)
    for _ in range(200):
        cameras.step(0, np.ones(12, np.float32), share=0.0)
        cameras.step_gain(1, np.array([1, -1, 0], np.float32))
    assert np.abs(cameras.twists).max() <= 0.035
    motions = cameras.poses() @ np.linalg.inv(truth)
    shift = motions[:, :3, 3]
    assert np.abs(shift[0]).max() > 0.02
    np.testing.assert_allclose(shift.mean(axis=0), 0, atol=2e-3)
    gains = np.log([cameras.gain(number) for number in range(COUNT)])
    np.testing.assert_allclose(gains.mean(axis=0), 0, atol=1e-6)
    assert gains[1, 0] < gains[2, 0] < 1 and gains[1, 1] > gains[2, 1] and gains[1, 2] == 0


def test_the_gradient_of_a_pose_is_that_of_a_small_motion_on_the_cameras_side():
    cameras = CameraCorrections(walk(2), depth=2.0, with_poses=True, exposure=False)
    for axis in range(6):
        # A loss that falls along one motion: its gradient by rotation and translation.
        start, motion = cameras.given[0], np.zeros(6)
        motion[axis] = 1e-5
        slope = -(move_pose(start, motion) - start)[:3] / 1e-5
        gradient = np.concatenate([slope[:, :3].ravel(), slope[:, 3]]).astype(np.float32)
        fresh = CameraCorrections(walk(2), depth=2.0, with_poses=True, exposure=False)
        fresh.step(0, gradient, share=0.0)
        assert fresh.twists[0, axis] == pytest.approx(1e-3, rel=1e-3)


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


def test_pictures_are_exposed():
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
