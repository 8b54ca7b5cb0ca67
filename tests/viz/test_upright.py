"""Up, guessed from the points alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from viz.viewer.standpoint import guess_up


def room(rng, *, wide=5.0, deep=4.0, high=2.5, noise=0.01):
    """Points on the floor, two walls and a table, z up."""
    at = rng.uniform(0, 1, (4, 5000, 3))
    at[0] *= (wide, deep, 0)
    at[1] *= (wide, 0, high)
    at[2] *= (0, deep, high)
    at[3] = at[3] * (1.5, 1.0, 0) + (2.0, 2.0, 0.7)
    return at.reshape(-1, 3) + rng.normal(0, noise, (20000, 3))


def degrees(one, other):
    return np.degrees(np.arccos(np.clip(one @ other, -1, 1)))


@pytest.mark.parametrize("tilt", [(0, 0, 0), (12, 0, 0), (8, -10, 70), (0, 30, 20)])
def test_the_floor_is_level_though_the_scenes_frame_is_tilted(tilt):
    turn = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
    points = room(np.random.default_rng(0))
    expected = turn @ [0, 0, 1]
    assert degrees(guess_up(points @ turn.T), expected) < 1
    # The same in the frame of a camera, whose y runs downwards; seen steeply from above, as well.
    for pitch in (0, 15):
        camera = Rotation.from_euler("x", 90 + pitch, degrees=True).as_matrix() @ turn
        seen = points @ camera.T + (0, 0, 40)
        assert degrees(guess_up(seen), camera @ [0, 0, 1]) < 1


@pytest.mark.parametrize(("size", "up"), [((4, 5, 2), (0, 0, 1)), ((4, 2, 5), (0, -1, 0))])
def test_without_surfaces_it_is_an_axis(size, up):
    points = np.random.default_rng(1).uniform(0, 1, (20000, 3)) * size
    np.testing.assert_array_equal(guess_up(points), up)
    np.testing.assert_array_equal(guess_up(points[:5]), up)


def test_a_wall_is_no_floor():
    rng = np.random.default_rng(2)
    wall = rng.uniform(0, 1, (20000, 3)) * (0, 5, 2) + rng.normal(0, 0.005, (20000, 3))
    np.testing.assert_array_equal(guess_up(wall), (0, 0, 1))
