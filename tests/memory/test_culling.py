from __future__ import annotations

import numpy as np
import pytest
from memory_scenes import camera, plane_view, random_camera

from gvtools.memory.back_projection import FREE_CELL
from gvtools.memory.culling import FARTHEST, STEP, behind_free_space, in_free_space
from gvtools.memory.spatial_memory import SpatialMemory


def _view(source, grid):
    return source.K[0], source.cam_from_world[0], grid


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("tolerance", [0.0, 0.03, 0.3])
def test_points_in_front_of_a_cell_by_the_margin_are_in_free_space(seed, tolerance):
    rng = np.random.default_rng(seed)
    where = rng.uniform((-3, -3, -1), (3, 3, 6), (2000, 3)).astype(np.float32)
    sources = [random_camera(rng, spread=0.5) for _ in range(3)]
    grids = [rng.uniform(-1, 6, (6, 8)).clip(0).astype(np.float32) for _ in sources]
    expected = np.zeros(len(where), bool)
    for source, grid in zip(sources, grids, strict=True):
        xy, z = source.project(where)
        for i in np.flatnonzero(z[0] > 0):
            column, row = np.floor(xy[0, i] / FREE_CELL).astype(int)
            if 0 <= row < 6 and 0 <= column < 8:
                expected[i] |= z[0, i] < grid[row, column] * (1 - tolerance)
    views = [_view(*pair) for pair in zip(sources, grids, strict=True)]
    found = in_free_space(where, views, tolerance=tolerance)
    assert 0.02 < expected.mean() < 0.9
    np.testing.assert_array_equal(found, expected)


def test_no_view_and_no_grid_free_nothing():
    where = np.array([(0, 0, 2)], np.float32)
    assert not in_free_space(where, [], tolerance=0.0).any()
    nothing = np.zeros((0, 0), np.float32)
    assert not in_free_space(where, [_view(camera(), nothing)], tolerance=0.0).any()


def test_points_move_back_along_their_rays_until_nothing_saw_past_them():
    source = camera(width=64, height=48, focal=60)
    views = [_view(source, plane_view(source, 4.0).free_depth)]
    rays = np.array([(0, 0, 1), (0.1, 0.1, 1), (0, 0, 1), (0, 0, 1), (5, 0, 1)], float)
    depth = np.array([2.0, 3.0, 4.1, 4 * 0.96 / FARTHEST / STEP, 2.0])
    moved = behind_free_space(np.zeros(3), rays, depth, views=views, tolerance=0.03)
    limit = 4 * 0.97
    assert ((moved[:2] >= limit) & (moved[:2] < limit * STEP)).all()
    # Behind the wall already; free for as far as is tried; out of the view.
    assert moved[2:].tolist() == [4.1, 0.0, 2.0]


def test_what_moves_back_is_taken_by_fusion():
    source = camera(width=64, height=48, focal=60)
    beside = camera(width=64, height=48, focal=60, center=(0.5, 0, 0))
    memory = SpatialMemory(0.05)
    grey, wall = np.full((48, 64, 3), 128, np.uint8), np.full((48, 64), 4, np.float32)
    memory.observe(grey, wall, source, round=0)
    made = np.full((48, 64), 3, np.float32)
    where = np.ones(made.shape, bool)
    moved = memory.behind_free_space(made, beside, where=where)
    assert moved.min() >= 3
    rejected = memory.observe(grey, moved, beside, round=1, generated=True).rejected_free
    assert rejected == 0
    assert memory.observe(grey, made, beside, round=1, generated=True).rejected_free > 1000
    untouched = memory.behind_free_space(made, beside, where=~where)
    np.testing.assert_array_equal(untouched, made)
