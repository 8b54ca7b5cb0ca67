from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, invert_rigid
from gvtools.errors import DegenerateError, OptionError
from gvtools.trajectories import focus_point, interpolate, look_at, orbit, spiral

pytestmark = pytest.mark.filterwarnings("error")
MAKERS: tuple[Callable[..., Cameras], ...] = (interpolate, orbit, spiral)


def keys(centers: Any, turns: Any = None) -> Cameras:
    """Cameras at centres (V, 3) with rotation vectors (V, 3), world from camera."""
    count = len(centers)
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, 3] = centers
    if turns is not None:
        pose[:, :3, :3] = Rotation.from_rotvec(np.asarray(turns, np.float64)).as_matrix()
    K = np.tile(np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), (count, 1, 1))
    return Cameras(K, invert_rigid(pose), np.full(count, 64), np.full(count, 48), ())


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
    """Three keys turn in place, the fourth moves: all of them lie on the path."""
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
