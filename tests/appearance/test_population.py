"""Where Gaussians are added and removed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from splat_scene import photographs, rough_gaussians, walk

from gvtools.appearance import population as module
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.population import (
    FAINTEST,
    LARGEST,
    MOST_OPAQUE,
    NEIGHBOURS,
    SHRINK,
    Population,
    Sample,
    from_depth,
    from_points,
)
from gvtools.appearance.splat.project_kernels import LOG_SCALE, LOGIT, QUATERNION, SH, VALUES
from gvtools.memory.store.local_frame import LocalFrame

WIDE = 2.0


def population(count: int = 10) -> Population:
    """Gaussians with a colour, a footprint and moments of their own; even ones are wide."""
    rng = np.random.default_rng(0)
    some = Gaussians.at(rng.normal(size=(count, 3)), np.zeros((count, 3)), sizes=np.ones(count))
    some.values[:, SH] = np.arange(count)
    footprint = np.linspace(0.1, 0.2, count).astype(np.float32)
    wide = np.where(np.arange(count) % 2, 0.5, 4.0)
    some.values[:, LOG_SCALE:QUATERNION] = np.log(wide * footprint)[:, None]
    people = Population(some.values, footprint)
    people.moments[:] = rng.normal(size=people.moments.shape)
    return people


def pulled(people: Population, rows) -> None:
    people.pull[rows] = np.arange(1, len(rows) + 1)
    people.pulls[:] = 2


def grow(people: Population, most: int = 100, threshold: float = 0.1) -> None:
    people.grow(threshold, most, wide=WIDE, rng=np.random.default_rng(1))


@pytest.mark.parametrize("most", [5, 10, 11, 13, 16, 100])
def test_growth_stops_at_the_number_allowed_with_those_pulled_most(most):
    people = population()
    pulled(people, [0, 3, 4, 7])
    grow(people, most)
    assert len(people) == max(10, min(most, 14))
    doubled = [colour for colour in range(10) if (people.values[:, SH] == colour).sum() == 2]
    assert doubled == sorted([0, 3, 4, 7][::-1][: max(0, min(most, 14) - 10)])


def test_only_those_that_are_pulled_more_than_the_threshold_double():
    people = population()
    pulled(people, [1, 2, 5])
    # Mean pulls are 0.5, 1 and 1.5.
    grow(people, threshold=0.9)
    colours, counts = np.unique(people.values[:, SH], return_counts=True)
    assert colours[counts == 2].tolist() == [2, 5]
    assert not people.pull.any() and not people.pulls.any()


def test_small_ones_get_a_twin_and_large_ones_are_split():
    people, before = population(), population()
    pulled(people, [4, 7])
    grow(people)
    twins = people.values[people.values[:, SH] == 7]
    np.testing.assert_array_equal(twins, before.values[[7, 7]])
    halves = people.values[people.values[:, SH] == 4]
    shrunk = np.exp(halves[:, LOG_SCALE:QUATERNION] - before.values[4, LOG_SCALE:QUATERNION])
    np.testing.assert_allclose(shrunk, 1 / SHRINK, rtol=1e-5)
    assert (halves[0, :3] != halves[1, :3]).all()
    np.testing.assert_array_equal(halves[:, QUATERNION:], before.values[[4, 4], QUATERNION:])


def test_halves_stay_inside_the_gaussian_that_they_come_from():
    # Needles in one direction: a half beside the needle is far off in standard deviations.
    angle, count = 0.6, 300
    needles = Gaussians.at(np.zeros((count, 3)), np.zeros((count, 3)), sizes=np.ones(count))
    needles.values[:, LOG_SCALE:QUATERNION] = np.log([1.0, 0.01, 0.01])
    needles.values[:, QUATERNION:LOGIT] = [2 * np.cos(angle / 2), 0, 0, 2 * np.sin(angle / 2)]
    people = Population(needles.values, np.full(count, 0.1, np.float32))
    pulled(people, np.arange(count))
    grow(people, most=1000)
    assert len(people) == 2 * count
    along = people.values[:, :3] @ [np.cos(angle), np.sin(angle), 0]
    across = people.values[:, :3] @ [-np.sin(angle), np.cos(angle), 0]
    assert 0.8 < along.std() < 1.2
    assert 0.008 < across.std() < 0.012
    assert 0.008 < people.values[:, 2].std() < 0.012


def test_footprints_are_inherited_and_moments_of_new_ones_are_zero():
    people, before = population(), population()
    pulled(people, [1, 4, 6, 9])
    grow(people)
    parents = people.values[:, SH].astype(int)
    np.testing.assert_array_equal(people.footprint, before.footprint[parents])
    same = (people.values == before.values[parents]).all(axis=1)
    old = np.array([row for row in range(len(people)) if same[row] and row < 8])
    np.testing.assert_array_equal(people.moments[:, old], before.moments[:, parents[old]])
    assert not people.moments[:, 8:].any()
    assert len(people.pull) == len(people.pulls) == len(people) == 14


def test_faint_ones_go_and_take_their_memory_with_them():
    people, before = population(), population()
    people.values[:, LOGIT] = np.log(FAINTEST / (1 - FAINTEST)) + 0.1
    people.values[[2, 5], LOGIT] -= 0.2
    people.remove_faint()
    kept = [0, 1, 3, 4, 6, 7, 8, 9]
    assert people.values[:, SH].tolist() == kept
    np.testing.assert_array_equal(people.footprint, before.footprint[kept])
    np.testing.assert_array_equal(people.moments, before.moments[:, kept])


def some_values() -> np.ndarray:
    values = rough_gaussians().values
    values[:, LOGIT] = np.linspace(-5, 6, len(values))
    return values


def test_those_that_are_left_stop_the_light_of_those_that_are_missing():
    values, before = some_values(), some_values()
    sample = Sample(values, 0.3, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(values, before)
    assert 0.62 < len(sample.values) / len(values) < 0.78
    rows = sample.back(
        np.arange(len(sample.values)), np.ones((len(sample.values), VALUES), np.float32)
    )
    assert (np.diff(rows) > 0).all()
    others = np.arange(VALUES) != LOGIT
    np.testing.assert_array_equal(sample.values[:, others], values[rows][:, others])
    opacity, raised = (1 / (1 + np.exp(-each[:, LOGIT])) for each in (values[rows], sample.values))
    np.testing.assert_allclose(raised, np.minimum(opacity / 0.7, MOST_OPAQUE), rtol=1e-4)


def test_gradients_come_back_by_the_chain_rule():
    values, rng = some_values(), np.random.default_rng(1)
    sample = Sample(values, 0.4, rng=rng)
    seen = np.arange(0, len(sample.values), 3)
    by_raised = rng.normal(size=(len(seen), VALUES)).astype(np.float32)
    gradients = by_raised.copy()
    rows = sample.back(seen, gradients)
    logits = torch.from_numpy(values[rows, LOGIT]).double().requires_grad_()
    raised = torch.clamp(torch.sigmoid(logits) / 0.6, max=MOST_OPAQUE)
    (torch.logit(raised) * torch.from_numpy(by_raised[:, LOGIT]).double()).sum().backward()
    assert logits.grad is not None
    assert 0.2 < (logits.grad == 0).double().mean() < 0.8
    np.testing.assert_allclose(gradients[:, LOGIT], logits.grad.numpy(), rtol=1e-2, atol=1e-4)
    others = np.arange(VALUES) != LOGIT
    np.testing.assert_array_equal(gradients[:, others], by_raised[:, others])


FRAME = LocalFrame.at([1.0, 2.0, 3.0])


def sizes(some):
    widths = np.exp(some.values[:, 3:6])
    np.testing.assert_array_equal(widths, widths[:, :1].repeat(3, axis=1))
    return widths[:, 0]


def colors_of(places):
    return np.full((len(places), 3), 100, np.uint8)


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
    monkeypatch.setattr(module, "STARTING_GAUSSIANS", 100)
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
