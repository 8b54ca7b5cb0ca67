from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, invert_rigid, rigid_poses
from gvtools.errors import DegenerateError, OptionError
from gvtools.trajectories import focus_point, interpolate, look_at, mean_up, orbit, spiral

UP = np.array([0.2, -0.5, 0.8]) / np.linalg.norm([0.2, -0.5, 0.8])
FOCUS = np.array([3.0, -1.0, 2.0])


def _cameras(world_from_cam: np.ndarray) -> Cameras:
    K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    return Cameras.alike(K, invert_rigid(world_from_cam), size=(640, 480))


def _ring(count: int = 7, *, arc: float = 1.5, radius: float = 4.0) -> Cameras:
    """Cameras on an arc about FOCUS with axis UP, a little above, all looking at FOCUS."""
    first = np.cross(UP, (1.0, 0, 0))
    first /= np.linalg.norm(first)
    angle = np.linspace(0, arc, count)[:, None]
    around = np.cos(angle) * first + np.sin(angle) * np.cross(UP, first)
    return _cameras(look_at(FOCUS + radius * around + 1.2 * UP, FOCUS, up=UP))


def _assert_rigid(cameras: Cameras) -> None:
    rotation = cameras.cam_from_world[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.swapaxes(1, 2), np.tile(np.eye(3), (len(cameras), 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)


def test_look_at_puts_the_target_on_the_axis_and_up_upwards():
    cameras = _ring()
    xy, z = cameras.project(FOCUS[None])
    np.testing.assert_allclose(xy[:, 0], [[320, 240]] * 7, atol=1e-9)
    np.testing.assert_allclose(z[:, 0], np.hypot(4.0, 1.2), atol=1e-12)
    _assert_rigid(cameras)
    # A point above the focus appears above it: y is down in the image.
    above, _ = cameras.project(FOCUS[None] + 0.1 * UP)
    assert (above[:, 0, 1] < 240).all()
    np.testing.assert_allclose(above[:, 0, 0], 320, atol=1e-9)


def test_interpolation_goes_through_its_keys():
    rng = np.random.default_rng(0)
    turns = Rotation.random(5, rng=rng).as_matrix()
    given = _cameras(rigid_poses(turns, rng.standard_normal((5, 3)) + 1e6))
    path = interpolate(given, 20_001)
    _assert_rigid(path)
    apart = np.linalg.norm(path.centers[:, None] - given.centers, axis=2)
    assert apart.min(axis=0).max() < 1e-3
    at = apart.argmin(axis=0)
    assert (np.diff(at) > 0).all()
    turn = (
        Rotation.from_matrix(path.cam_from_world[at, :3, :3])
        * Rotation.from_matrix(given.cam_from_world[:, :3, :3]).inv()
    )
    assert turn.magnitude().max() < 2e-3
    for end in (0, -1):
        np.testing.assert_allclose(path.centers[end], given.centers[end], atol=1e-8)


def test_intrinsics_are_interpolated_and_sizes_are_the_nearest_keys():
    ends = _ring(2)
    K = ends.K.copy()
    K[1, 0, 0] = 600
    mixed = Cameras(K, ends.cam_from_world, np.array([640, 320]), np.array([480, 240]), ends.names)
    path = interpolate(mixed, 5)
    np.testing.assert_allclose(path.K[:, 0, 0], [500, 525, 550, 575, 600])
    assert path.width.tolist() == [640, 640, 640, 320, 320]


def test_the_focus_point_is_where_the_axes_meet():
    np.testing.assert_allclose(focus_point(_ring()), FOCUS, atol=1e-9)
    offset = np.array([6.9e5, 5.3e6, 0])
    far = _ring().world_from_cam
    far[:, :3, 3] += offset
    np.testing.assert_allclose(focus_point(_cameras(far)), FOCUS + offset, atol=1e-6)


def test_an_orbit_looks_at_its_middle_with_a_steady_up():
    path = orbit(_ring(), 24)
    _assert_rigid(path)
    xy, z = path.project(FOCUS[None])
    np.testing.assert_allclose(xy[:, 0], [[320, 240]] * 24, atol=1e-6)
    np.testing.assert_allclose(z, z[0, 0], atol=1e-9)
    # No roll: the image's x axis stays across the up vector, and up points up.
    up = mean_up(_ring())
    np.testing.assert_allclose(path.world_from_cam[:, :3, 0] @ up, 0, atol=1e-12)
    assert (path.world_from_cam[:, :3, 1] @ up < 0).all()
    # It begins in the direction of the first camera, at the cameras' distance.
    np.testing.assert_allclose(np.linalg.norm(path.centers - FOCUS, axis=1), np.hypot(4, 1.2), 0.01)
    assert path.centers[0] == pytest.approx(_ring().centers[0], abs=0.3)
    steps = np.linalg.norm(np.diff(np.vstack([path.centers, path.centers[:1]]), axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)


def test_a_spiral_stays_within_the_capture_and_looks_at_one_point():
    rng = np.random.default_rng(4)
    centers = np.column_stack([rng.uniform(-1, 1, 40), rng.uniform(-0.5, 0.5, 40), np.zeros(40)])
    target = np.array([0.0, 0.0, 6.0])
    given = _cameras(look_at(centers, target, up=(0, -1, 0)))
    path = spiral(given, 60)
    _assert_rigid(path)
    assert (np.abs(path.centers[:, :2]).max(axis=0) < (1, 0.5)).all()
    assert np.ptp(path.centers[:, 0]) > 1 and np.ptp(path.centers[:, 1]) > 0.5
    xy, _ = path.project(focus_point(path)[None])
    np.testing.assert_allclose(xy[:, 0], [[320, 240]] * 60, atol=1e-6)
    assert np.linalg.norm(focus_point(path) - target) < 1.0


def test_degenerate_paths_say_why():
    with pytest.raises(OptionError, match="2 or more"):
        interpolate(_ring(1), 5)
    with pytest.raises(DegenerateError, match="same"):
        interpolate(_ring(3)[[1, 1]], 5)
    parallel = keys([(0, 0, 0), (1, 0, 0), (2, 0, 0)])
    with pytest.raises(DegenerateError, match="parallel"):
        focus_point(parallel)
    orbit(parallel, 4, center=(0, 0, 5))
    with pytest.raises(OptionError, match="1 or more"):
        orbit(_ring(), 0)
    with pytest.raises(DegenerateError, match="on the axis"):
        orbit(_ring(), 5, center=_ring().centers[0])
    with pytest.raises(DegenerateError, match="cancel"):
        mean_up(_cameras(np.stack([np.eye(4), np.diag([-1.0, -1, 1, 1])])))


pytestmark = pytest.mark.filterwarnings("error")
MAKERS: tuple[Callable[..., Cameras], ...] = (interpolate, orbit, spiral)


def keys(centers: Any, turns: Any = None) -> Cameras:
    """Cameras at centres (V, 3) with rotation vectors (V, 3), world from camera."""
    turns = np.zeros((len(centers), 3)) if turns is None else np.asarray(turns, np.float64)
    return _cameras(rigid_poses(Rotation.from_rotvec(turns).as_matrix(), centers))


def arc(unit: float = 1.0) -> Cameras:
    t = np.linspace(0, 1.5, 7)
    centers = np.stack([np.cos(t), np.sin(t), 0.3 * t**2], 1)
    return keys(unit * centers, np.stack([0.2 * t, t, 0 * t], 1))


@settings(max_examples=30, deadline=None)
@given(st.integers(-29, 29))
def test_paths_are_those_of_the_scene_in_any_unit(power):
    unit = 10.0**power
    for make in MAKERS:
        path, plain = make(arc(unit), 5), make(arc(), 5)
        np.testing.assert_allclose(path.centers / unit, plain.centers, atol=1e-9)
        turns = path.cam_from_world[:, :3, :3], plain.cam_from_world[:, :3, :3]
        np.testing.assert_allclose(*turns, atol=1e-9)
    np.testing.assert_allclose(focus_point(arc(unit)) / unit, focus_point(arc()), atol=1e-9)


@pytest.mark.parametrize("gap", [0.0, 1e-12, 9e-10, 1.1e-9])
@pytest.mark.parametrize("where", ["first", "middle", "last"])
def test_keys_that_all_but_repeat_another_do_no_harm(gap, where):
    rows = {"first": (0, gap, 1, 2), "middle": (0, 1, 1 + gap, 2), "last": (0, 1, 2, 2 + gap)}
    path = interpolate(keys([(x, 0, 0) for x in rows[where]]), 5).centers
    np.testing.assert_allclose(path[:, 0], np.linspace(0, 2, 5), atol=3e-8)
    np.testing.assert_array_equal(path[:, 1:], 0)


@pytest.mark.parametrize("noise", [0.0, 1e-17, 1e-14])
@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_a_turn_on_the_spot_counts_though_centres_differ_by_rounding(noise, offset):
    centers = [(offset + x, 0, 0) for x in (0, noise, 2 * noise, 3 * noise, 1)]
    turns = [(0, angle, 0) for angle in (0, 0.5, 1, 1.5, 1.5)]
    path = interpolate(keys(centers, turns), 401)
    at_rest = path.centers[:, 0] - offset < 1e-6
    angles = Rotation.from_matrix(path.world_from_cam[:, :3, :3]).as_rotvec()[:, 1]
    assert angles[at_rest].max() == pytest.approx(1.5, abs=0.01)
    assert 0.4 < at_rest.mean() < 0.8


@settings(max_examples=40, deadline=None)
@given(
    st.one_of(
        st.sampled_from([0.0, 1e-16, 1e-8, np.pi - 1e-8, np.pi - 1e-15, np.pi]), st.floats(0, np.pi)
    ),
    st.integers(0, 50),
)
def test_the_middle_of_any_turn_is_half_of_it(angle, seed):
    axis = np.random.default_rng(seed).standard_normal(3)
    axis /= np.linalg.norm(axis)
    path = interpolate(keys([(0, 0, 0), (1, 0, 0)], [(0, 0, 0), angle * axis]), 3)
    half = Rotation.from_matrix(path.world_from_cam[1, :3, :3]).as_rotvec()
    # A half turn may go either way about its axis.
    gap = min(np.abs(half - 0.5 * angle * axis).max(), np.abs(half + 0.5 * angle * axis).max())
    assert gap < 1e-12
    assert angle >= np.pi - 1e-12 or np.abs(half - 0.5 * angle * axis).max() < 1e-12


def test_a_point_to_look_at_has_to_differ_from_the_centre_beyond_rounding():
    for center, target in (((0, 0, 0), (0, 0, 0)), ((0, 0, 1e9), (0, 0, 1e9 + 1e-4))):
        with pytest.raises(DegenerateError, match="lies on the point"):
            look_at([center], target, up=(0, 1, 0))
    with pytest.raises(OptionError, match="up"):
        look_at([(0, 0, 0)], (0, 0, 1), up=(0, 0, 0))
    near = look_at([(0, 0, 0)], (0, 0, 1e-29), up=(0, -1, 0))[0]
    np.testing.assert_array_equal(near, np.eye(4))


@pytest.mark.parametrize("angle", [1e-1, 1e-2, 1e-3])
def test_the_focus_of_nearly_parallel_axes_is_found_or_refused(angle):
    meeting = focus_point(keys([(0, 0, 0), (1, 0, 0)], [(0, 0, 0), (0, -angle, 0)]))
    np.testing.assert_allclose(meeting * np.tan(angle), (0, 0, 1), atol=1e-9)
    with pytest.raises(DegenerateError, match="parallel"):
        focus_point(keys([(0, 0, 0), (1, 0, 0)], [(0, 0, 0), (0, -1e-4, 0)]))
