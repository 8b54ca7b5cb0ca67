"""Where Gaussians are added and removed."""

from __future__ import annotations

import numpy as np
import pytest

from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.population import FAINTEST, SHRINK, Population
from gvtools.appearance.splat.project_kernels import LOG_SCALE, LOGIT, QUATERNION, SH

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


def test_all_fade_by_a_share_of_their_opacity():
    people = population()
    people.values[:, LOGIT] = np.linspace(-4, 4, len(people))
    before = 1 / (1 + np.exp(-people.values[:, LOGIT]))
    people.fade(0.1)
    after = 1 / (1 + np.exp(-people.values[:, LOGIT]))
    np.testing.assert_allclose(after, 0.9 * before, rtol=1e-5)
