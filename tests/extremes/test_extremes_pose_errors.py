from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvtools.errors import DegenerateError, ShapeError
from gvtools.evaluation.trajectories import (
    AUC_BINS,
    absolute_errors,
    area_under_recall,
    pose_auc,
    relative_errors,
)

pytestmark = pytest.mark.filterwarnings("error")


def path(count: int = 9, *, unit: float = 1.0) -> np.ndarray:
    t = np.linspace(0, 2, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = unit * np.stack([np.cos(t), np.sin(t), 0.3 * t**2], 1)
    poses[:, :3, :3] = Rotation.from_rotvec(np.stack([0.2 * t, t, 0 * t], 1)).as_matrix()
    return poses


def turned(poses: np.ndarray, angle: float, axis: tuple[float, float, float]) -> np.ndarray:
    """Every camera turned about an axis of the world, where it stands."""
    rotation = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    out = poses.copy()
    out[:, :3, :3] = rotation @ poses[:, :3, :3]
    return out


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


@pytest.mark.parametrize("angle", [0.0, 1e-16, 1e-8, 1e-3, np.pi - 1e-6, np.pi - 1e-12, np.pi])
def test_angles_are_exact_near_none_and_near_a_half_turn(angle):
    other = turned(path(), angle, (1, 2, 2))
    errors = absolute_errors(path(), other, align="none")
    assert errors.rotation_deg is not None
    for value in (errors.rotation_deg.min, errors.rotation_deg.max):
        # Entries of a rotation matrix end at 1e-16: so do the angles that it tells.
        assert value == pytest.approx(np.degrees(angle), rel=1e-13, abs=1e-13)


def test_a_path_walked_the_other_way_has_opposite_directions():
    line = np.tile(np.eye(4), (5, 1, 1))
    line[:, 0, 3] = np.arange(5)
    back = line.copy()
    back[:, 0, 3] *= -1
    auc = pose_auc(line, back)
    assert auc.median_direction_deg == 180
    assert auc.median_rotation_deg == 0
    assert set(auc.auc.values()) == {0}
    assert absolute_errors(path(), path() * [[1, 1, 1, -1]] * 1.0).status.startswith("degenerate")


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
    with pytest.raises(DegenerateError, match="no errors"):
        area_under_recall([], 10.0)
