from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera, points
from reference_fusion import ReferenceMemory, chains_of

from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.store.voxel_index import EMPTY_KEY, MAX_VOXEL, group_by_block, voxel_keys

ONE_EDGE = MemoryOptions(voxels_per_footprint=0.0)


def _cloud(rng: np.random.Generator, count: int, source):
    """Points crowded into few voxels."""
    return points(
        rng.normal((0, 0, 2), 0.15, (count, 3)),
        source=source,
        colors=rng.integers(0, 256, (count, 3)),
        confidence=rng.uniform(0.1, 3, count),
        spacing=rng.uniform(0.02, 0.4, count),
    )


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    views=st.integers(1, 12),
    capacity=st.integers(1, 4),
    degrees=st.sampled_from([1.0, 5.0, 20.0]),
    footprints=st.sampled_from([0.0, 0.5, 1.0, 3.0]),
)
def test_fusion_does_what_a_plain_dictionary_does(seed, views, capacity, degrees, footprints):
    rng = np.random.default_rng(seed)
    options = MemoryOptions(
        merge_angle_deg=degrees, observations_per_voxel=capacity, weight_cap=4.0,
        voxels_per_footprint=footprints,
    )  # fmt: skip
    memory, reference = SpatialMemory(0.1, options=options), ReferenceMemory(0.1, options)
    for view in range(views):
        source = camera(center=rng.normal(0, 0.3, 3))
        fresh = _cloud(rng, int(rng.integers(1, 80)), source)
        generated = bool(rng.random() < 0.3)
        report = memory.fuse(fresh, round=view // 3, generated=generated)
        expected = reference.fuse(fresh, round=view // 3, generated=generated)
        assert {name: getattr(report, name) for name in expected} == expected
        assert report.added + report.merged + report.rejected == report.points == len(fresh)
    found = chains_of(memory)
    assert found.keys() == reference.chains.keys()
    assert memory.voxels == len(found)
    for cell, chain in reference.chains.items():
        assert [o.view for o in found[cell]] == [o.view for o in chain]
        for one, two in zip(found[cell], chain, strict=True):
            np.testing.assert_allclose(one.position, two.position, atol=2e-6)
            np.testing.assert_allclose(one.color, two.color, atol=1)
            assert one.confidence == pytest.approx(two.confidence, rel=1e-5)
            assert one.spacing == pytest.approx(two.spacing, rel=1e-5)
            assert one.agreement == pytest.approx(two.agreement, rel=1e-5)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), voxel=st.floats(0.003, 3), far=st.floats(0, 1000))
def test_voxels_are_the_distinct_floors_of_position_over_edge(seed, voxel, far):
    rng = np.random.default_rng(seed)
    where = (rng.normal(0, 1, (300, 3)) + far * rng.normal(0, 1, 3)).astype(np.float32)
    memory = SpatialMemory(voxel, options=ONE_EDGE)
    report = memory.fuse(points(where), round=0)
    cells = np.floor(where.astype(float) * (1.0 / voxel))
    assert memory.voxels == report.voxels == len(memory) == len(np.unique(cells, axis=0))
    stored = np.floor(memory.columns.positions.astype(float) * (1.0 / voxel))
    np.testing.assert_array_equal(np.unique(stored, axis=0), np.unique(cells, axis=0))


def test_points_of_one_voxel_are_averaged_by_confidence():
    memory = SpatialMemory(1.0, options=ONE_EDGE)
    fresh = points(
        [(0.2, 0.2, 2.2), (0.6, 0.2, 2.2)], colors=[(0, 0, 0), (200, 100, 40)], confidence=(1, 3),
        spacing=(1.0, 5.0),
    )  # fmt: skip
    memory.fuse(fresh, round=0)
    assert len(memory) == 1
    np.testing.assert_allclose(memory.positions, [(0.5, 0.2, 2.2)], rtol=1e-6)
    np.testing.assert_array_equal(memory.columns.colors[0], (150, 75, 30))
    assert memory.columns.spacing[0] == 4
    # Pixels of one view are no independent witnesses: their confidence does not add up.
    assert memory.confidence[0] == 3


def test_views_of_one_direction_merge_and_the_weight_is_capped():
    memory = SpatialMemory(1.0, options=MemoryOptions(weight_cap=2.5))
    for number, (x, weight) in enumerate(((0.2, 1.0), (0.4, 1.0), (0.8, 2.0))):
        source = camera(name=f"v{number}")
        memory.fuse(points([(x, 0.5, 5.5)], source=source, confidence=weight), round=0)
    assert len(memory) == 1
    assert memory.columns.view[0] == 0  # ties and capped weights stay with the earlier view
    np.testing.assert_allclose(memory.positions[0, 0], 0.3 + 0.5 * (0.8 - 0.3), rtol=1e-6)
    assert memory.confidence[0] == 2.5
    last = camera(name="last")
    memory.fuse(points([(0.5, 0.5, 5.5)], source=last, confidence=2.6), round=0)
    assert memory.columns.view[0] == 3  # the more confident view wins, numbers are not averaged


@pytest.mark.parametrize(("degrees", "kept"), [(1.9, 1), (2.1, 2)])
def test_directions_beyond_the_threshold_stand_side_by_side(degrees, kept):
    memory = SpatialMemory(0.5, options=MemoryOptions(merge_angle_deg=2))
    for angle in (0, np.radians(degrees)):
        source = camera(center=(-4 * np.sin(angle), 0, 4.25 - 4 * np.cos(angle)))
        memory.fuse(points([(0, 0, 4.25)], source=source), round=0)
    assert len(memory) == kept
    assert memory.voxels == 1


def test_a_close_up_is_not_averaged_into_a_distant_view():
    memory = SpatialMemory(0.1, options=ONE_EDGE)
    memory.fuse(points([(0.05, 0.05, 8.05)], spacing=0.8), round=0)
    memory.fuse(points([(0.05, 0.05, 8.05)], spacing=0.2), round=0)
    assert len(memory) == 2
    memory.fuse(points([(0.05, 0.05, 8.05)], spacing=0.7), round=0)
    assert len(memory) == 2


def test_observed_points_pass_generated_ones_by():
    """Generated neighbours neither take observed points in nor stop them from merging."""
    memory = SpatialMemory(1.0)
    place = [(0.5, 0.5, 5.5)]
    assert memory.fuse(points(place), round=0, generated=True).added == 1
    assert memory.fuse(points(place, colors=(9, 9, 9)), round=0).added == 1
    for _ in range(5):
        assert memory.fuse(points(place, colors=(9, 9, 9)), round=0).merged == 1
    assert memory.generated.tolist() == [True, False]
    np.testing.assert_array_equal(memory.columns.colors[:2], [(128,) * 3, (9,) * 3])
    assert memory.columns.confidence[:2].tolist() == [1, 6]
    report = memory.fuse(points(place * 3), round=1, generated=True)
    assert (report.rejected_observed, report.added, report.merged) == (3, 0, 0)


def test_keys_tell_voxels_apart_and_mark_what_is_out_of_reach():
    edge = 0.5
    where = np.array(
        [(0, 0, 0), (-1e-6, 0, 0), (0.49, 0.49, 0.49), (0.5, 0, 0), (MAX_VOXEL * edge, 0, 0),
         (0, -MAX_VOXEL * edge * 1.01, 0), (np.inf, 0, 0), (0, np.nan, 0)], np.float32,
    )  # fmt: skip
    keys, places = np.empty(8, np.int64), np.zeros(8, np.uint16)
    assert voxel_keys(where, np.zeros(8, np.uint8), 1 / edge, keys, places) == 4
    assert (keys[4:] == EMPTY_KEY).all()
    assert (keys[:4] != EMPTY_KEY).all()
    names = list(zip(keys[:4].tolist(), places[:4].tolist(), strict=True))
    assert names[0] == names[2]
    assert len(set(names)) == 3
    # Voxels of the next level are twice as wide, go twice as far and are others.
    above, there = np.empty(8, np.int64), np.zeros(8, np.uint16)
    assert voxel_keys(where, np.ones(8, np.uint8), 1 / edge, above, there) == 2
    assert above[0] == above[3] and there[0] == there[3]
    assert not set(above[:6].tolist()) & set(keys[:4].tolist())


def test_grouping_is_a_stable_sort_by_first_appearance():
    rng = np.random.default_rng(2)
    blocks = rng.integers(0, 40, 500).astype(np.int32)
    touched, starts, order = group_by_block(blocks, 50)
    first = list(dict.fromkeys(blocks.tolist()))
    assert touched.tolist() == first
    for rank, block in enumerate(first):
        rows = order[starts[rank] : starts[rank + 1]]
        np.testing.assert_array_equal(rows, np.flatnonzero(blocks == block))
