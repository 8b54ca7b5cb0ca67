"""The Gaussians that a fit begins with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from splat_scene import photographs, walk

from gvtools.appearance import population
from gvtools.appearance.population import LARGEST, NEIGHBOURS, from_depth, from_points
from gvtools.memory.store.local_frame import LocalFrame

FRAME = LocalFrame.at([1.0, 2.0, 3.0])


def sizes(some):
    widths = np.exp(some.values[:, 3:6])
    np.testing.assert_array_equal(widths, widths[:, :1].repeat(3, axis=1))
    return widths[:, 0]


def colors_of(places):
    return np.full((len(places), 3), 100, np.uint8)


def test_points_of_a_grid_are_as_wide_as_it():
    places = np.mgrid[0:1.25:0.25, 7:8.25:0.25, 900:901.25:0.25].reshape(3, -1).T
    some = from_points(places, colors_of(places), frame=FRAME)
    np.testing.assert_allclose(sizes(some), 0.25, rtol=1e-3)
    np.testing.assert_allclose(some.values[:, :3], places, rtol=1e-6)
    assert some.frame is FRAME


def test_sizes_are_distances_to_the_nearest_neighbours():
    places = np.random.default_rng(0).normal(size=(500, 3))
    distances, _ = cKDTree(places).query(places, NEIGHBOURS + 1)
    expected = np.sqrt(np.square(distances[:, 1:]).mean(axis=1))
    found = sizes(from_points(places, colors_of(places), frame=FRAME))
    usual = expected < np.quantile(expected, LARGEST)
    np.testing.assert_allclose(found[usual], expected[usual], rtol=1e-4)
    np.testing.assert_allclose(found[~usual], np.quantile(expected, LARGEST), rtol=1e-4)


def test_points_in_one_place_still_have_a_size():
    places = np.random.default_rng(0).normal(size=(100, 3))
    places[:20] = places[0]
    found = sizes(from_points(places, colors_of(places), frame=FRAME))
    assert found[:20].min() == found.min() > 0
    assert np.isfinite(found).all()


@pytest.mark.parametrize("count", [2, 3])
def test_fewer_points_than_neighbours_are_enough(count):
    places = np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])[:count]
    found = sizes(from_points(places, colors_of(places), frame=FRAME))
    assert (found > 0.3).all() and (found < 1).all()


@pytest.mark.parametrize(("most", "kept"), [(None, 100), (60, 50), (100, 100), (7, 7)])
def test_many_points_are_thinned_evenly(monkeypatch, most, kept):
    monkeypatch.setattr(population, "STARTING_GAUSSIANS", 100)
    places = np.random.default_rng(0).normal(size=(100, 3))
    colors = np.arange(300, dtype=np.uint8).reshape(100, 3)
    some = from_points(places, colors, frame=FRAME, most=most)
    assert len(some) == kept
    rows = np.arange(0, 100, -(-100 // kept))
    np.testing.assert_allclose(some.values[:, :3], places[rows], rtol=1e-6)


def test_pixels_with_depth_become_gaussians_on_the_surface():
    views = photographs(walk(3), depth=True)
    mask = np.ones(views[0].rgb.shape[:2], bool)
    mask[:, 20:] = False
    first, second = views[0].depth, views[1].depth
    assert first is not None and second is not None
    second = np.where(second > 2.5, np.float32(0), second)
    views[0], views[1] = replace(views[0], mask=mask), replace(views[1], depth=second)
    views[2] = replace(views[2], depth=None)
    some = from_depth(views, frame=FRAME, seed=0, most=400)
    assert 200 < len(some) <= 400
    missed = 0
    for place, color in zip(some.values[:, :3], some.values[:, 11:14], strict=True):
        rgb = (0.5 + 0.28209479177387814 * color) * 255
        matches = False
        for view, depth, usable in ((views[0], first, mask), (views[1], second, second > 0)):
            point = view.cam_from_local[:3, :3] @ place + view.cam_from_local[:3, 3]
            x, y = (view.K @ point)[:2] / point[2] - 0.5
            row, column = round(y), round(x)
            if 0 <= row < 36 and 0 <= column < 48 and usable[row, column]:
                same = np.abs(view.rgb[row, column] - rgb).max() < 1
                centred = abs(x - column) < 1e-3 and abs(y - row) < 1e-3
                matches |= same and centred and abs(depth[row, column] - point[2]) < 1e-4
        missed += not matches
    assert missed == 0


def test_pixels_are_picked_by_the_seed_and_each_at_most_once():
    views = photographs(walk(2), depth=True)
    one, same, other = (
        from_depth(views, frame=FRAME, seed=seed, most=300).values for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert len(np.unique(one[:, :3], axis=0)) == len(one) == 300
    assert (one[:, :3] != other[:, :3]).any()
