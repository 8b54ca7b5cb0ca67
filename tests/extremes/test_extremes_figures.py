from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.errors import ShapeError
from gvtools.evaluation.depth_reprojection import depth_reprojection
from gvtools.evaluation.feature_consistency import feature_consistency
from gvtools.evaluation.images import image_figures, psnr, ssim
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.evaluation.statistics import mean_interval
from gvtools.evaluation.trajectories import (
    AUC_BINS,
    absolute_errors,
    area_under_recall,
    pose_auc,
    relative_errors,
)

pytestmark = pytest.mark.filterwarnings("error")

NOISE = np.random.default_rng(0).random((20, 24, 3))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 255.0, -1.01])
@pytest.mark.parametrize("call", [psnr, ssim, lambda a, b: image_figures(a, b, {"": None})])
def test_values_that_are_no_colours_are_refused_wherever_they_stand(call, bad):
    damaged = NOISE.copy()
    damaged[0, 0, 1] = bad
    for pair in ((damaged, NOISE), (NOISE, damaged)):
        with pytest.raises(ShapeError, match=r"expected floats in \[0, 1\]"):
            call(*pair)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (10, 11), (0, 5)])
def test_small_and_empty_pictures_have_what_they_can_have(size):
    picture = np.full((*size, 3), 0.5)
    wanted = math.inf if picture.size else None
    assert psnr(picture, picture) == wanted
    assert image_figures(picture, picture, {"": None})[""] == {"psnr": wanted, "ssim": None}
    with pytest.raises(ShapeError, match="11x11"):
        ssim(picture, picture)


@pytest.mark.parametrize(
    ("values", "mean", "n"),
    [
        ([None, math.nan], None, 0),
        ([-math.inf, 1.0], -math.inf, 2),
        ([math.inf, -math.inf], None, 2),
        ([1e-30], 1e-30, 1),
    ],
)
def test_means_that_have_no_interval(values, mean, n):
    found = mean_interval(values)
    assert (found.mean, found.low, found.high, found.n) == (mean, None, None, n)


SIZE = (24, 32)
TEXTURE = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)


def wall(*, depth: float | None = 2.0, shift: float = 0.0) -> PosedPicture:
    pose = np.eye(4)
    pose[0, 3] = -shift
    camera = Cameras.pinhole(SIZE[1], SIZE[0], focal=30, cam_from_world=pose)
    lengths = None if depth is None else np.full(SIZE, depth, np.float32)
    return PosedPicture(f"at {shift:g}", camera, TEXTURE, lengths, None)


@settings(max_examples=30, deadline=None)
@given(st.integers(-36, 36), st.sampled_from([0.0, 0.1, 0.5]))
def test_exact_depth_agrees_in_any_unit(power, step):
    unit = 10.0**power
    first, second = wall(depth=2 * unit), wall(depth=2 * unit, shift=step * unit)
    found = depth_reprojection(first, second)
    assert found.ok
    assert found.mean_pixels == pytest.approx(0, abs=1e-10)
    assert found.mean_relative_depth == pytest.approx(0, abs=1e-12)
    # The wall moves by 30 step / 2 pixels.
    assert found.covisible == pytest.approx(24 * (32 - 15 * step), abs=24)


@pytest.mark.parametrize("depth", [np.nan, np.inf, -np.inf, 0.0, -1.0, None])
def test_depth_that_is_none_gives_a_status_and_no_figure(depth):
    for first, second in ((wall(depth=depth), wall()), (wall(), wall(depth=depth))):
        found = depth_reprojection(first, second)
        assert found.status.startswith("empty: ")
        assert found.mean_pixels is found.mean_relative_depth is None
        features = feature_consistency(first, second)
        assert features.status.startswith("empty: ")
        assert features.score is None and features.places == 0


def path(count: int = 9, *, unit: float = 1.0) -> np.ndarray:
    t = np.linspace(0, 2, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = unit * np.stack([np.cos(t), np.sin(t), 0.3 * t**2], 1)
    poses[:, :3, :3] = Rotation.from_rotvec(np.stack([0.2 * t, t, 0 * t], 1)).as_matrix()
    return poses


@settings(max_examples=30, deadline=None)
@given(st.integers(-29, 29))
def test_errors_scale_with_the_unit(power):
    unit = 10.0**power
    noise = 0.1 * np.random.default_rng(0).standard_normal((9, 3))
    found = []
    for scale in (1.0, unit):
        other = path(unit=scale)
        other[:, :3, 3] += scale * noise
        reference = path(unit=scale)
        ate = absolute_errors(reference, other).translation
        rpe = relative_errors(reference, other).translation
        auc = pose_auc(reference, other)
        assert ate is not None and rpe is not None
        found.append((ate.rmse / scale, rpe.rmse / scale, auc.median_direction_deg, auc.auc[30.0]))
    plain, scaled = np.array(found, np.float64)
    np.testing.assert_allclose(scaled, plain, rtol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-8, np.pi - 1e-12, np.pi])
def test_angles_are_exact_near_none_and_near_a_half_turn(angle):
    other = path()
    turn = Rotation.from_rotvec(angle * np.array([1, 2, 2]) / 3).as_matrix()
    other[:, :3, :3] = turn @ other[:, :3, :3]
    errors = absolute_errors(path(), other, align="none")
    assert errors.rotation_deg is not None
    for value in (errors.rotation_deg.min, errors.rotation_deg.max):
        # Entries of a rotation matrix end at 1e-16: so do the angles that it tells.
        assert value == pytest.approx(np.degrees(angle), rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("offset", [0.0, 1.0, 5e6])
def test_cameras_at_one_place_have_no_direction_up_to_rounding(offset):
    rng = np.random.default_rng(0)
    reference, estimate = path(), path()
    for poses in (reference, estimate):
        poses[:, :3, 3] = offset * (1 + 1e-15 * rng.standard_normal((9, 3)))
    auc = pose_auc(reference, estimate)
    assert auc.still == auc.pairs == 36
    assert auc.median_direction_deg is None
    assert auc.auc[3.0] == pytest.approx(1 - 0.5 / AUC_BINS)
    assert "coincident" in absolute_errors(reference, estimate).status


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_an_estimate_that_stands_still_is_off_by_a_right_angle(offset):
    estimate = path()
    noise = 1e-15 * np.random.default_rng(1).standard_normal((9, 3))
    estimate[:, :3, 3] = offset * (1 + noise)
    auc = pose_auc(path(), estimate)
    assert auc.still == 0
    assert auc.median_direction_deg == 90


@pytest.mark.parametrize("spoil", [np.zeros((3, 3)), np.diag([1.0, 1, -1]), 2 * np.eye(3)])
def test_what_is_no_rotation_is_refused_and_named(spoil):
    broken = path()
    broken[3, :3, :3] = spoil
    for call in (absolute_errors, relative_errors, pose_auc):
        with pytest.raises(ShapeError, match="estimate pose 3 is no rotation"):
            call(path(), broken)
        with pytest.raises(ShapeError, match="reference pose 3 is no rotation"):
            call(broken, path())


def test_an_error_that_is_no_number_is_a_failure():
    assert area_under_recall([np.nan, np.inf], 10.0) == 0
    assert area_under_recall([0.0, np.nan], 10.0) == pytest.approx(0.5, abs=1e-3)
