"""Parts of space: each observation in one, all about as large; those near a camera are found."""

from __future__ import annotations

import numpy as np
import pytest
from memory_scenes import camera, points

from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from viz.run_view.chunks import MOST_NODES, ChunkRows, Chunks
from viz.run_view.detail import cell_keys

SIZE, CELL = 100, 0.05


@pytest.fixture(scope="module")
def memory():
    """Two walls and stray points far off, in two rounds."""
    rng = np.random.default_rng(0)
    options = MemoryOptions(voxels_per_footprint=0.0)
    found = SpatialMemory(0.01, origin=(5.0, 0.0, -2.0), options=options)
    for round, z in enumerate((2.0, 4.0)):
        wall = rng.uniform(-2, 2, (4000, 3))
        wall[:, 2] = z
        stray = rng.uniform(-300, 300, (20, 3))
        at = np.concatenate([wall, stray]) + found.origin
        found.fuse(points(at, origin=found.origin), round=round)
    return found


@pytest.fixture(scope="module")
def chunks(memory):
    return Chunks.of(memory, SIZE, cell=CELL)


@pytest.fixture(scope="module")
def table(memory, chunks):
    return ChunkRows.of(memory, chunks)


def seen_by(memory, x, y, z, **options):
    """A camera in the memory's frame, at a place of it."""
    center = memory.origin + np.array([x, y, z])
    return memory.frame.seen_from(camera(center=center, **options))


def test_each_observation_is_in_one_chunk_and_all_are_about_as_large(memory, chunks, table):
    assert len(chunks) == 128  # 8040 / 100, to the next power of two
    held = [table.rows(chunk) for chunk in range(len(chunks))]
    assert sorted(np.concatenate(held).tolist()) == list(range(len(memory)))
    sizes = [len(rows) for rows in held]
    # Walls have many equal coordinates, and what lies far off must not draw the cuts there.
    fair = len(memory) / len(chunks)
    assert np.percentile(sizes, 5) > 0.6 * fair and max(sizes) < 2 * fair
    position = memory.columns.positions
    for chunk, rows in enumerate(held):
        assert (np.diff(rows) > 0).all()
        assert (chunks.number(memory, rows) == chunk).all()
        np.testing.assert_array_equal(table.boxes[chunk, 0], position[rows].min(axis=0))
        np.testing.assert_array_equal(table.boxes[chunk, 1], position[rows].max(axis=0))


def test_no_cell_of_the_coarse_points_is_cut(memory, chunks):
    number = chunks.number(memory, np.arange(len(memory)))
    both = np.column_stack([cell_keys(memory, CELL), number])
    assert len(np.unique(both, axis=0)) == len(np.unique(both[:, 0]))


def test_chunks_in_view_are_found_nearest_first(memory, table):
    cam = seen_by(memory, 0.3, -0.2, 1.2, rotation=(0.1, -0.4, 0.2))
    found = table.near(cam, reach=np.inf, budget=len(memory))
    xy, z = cam.project(memory.columns.positions.astype(np.float64))
    size = np.array([cam.width[0], cam.height[0]])
    seen = (z[0] > 0) & (xy[0] >= 0).all(axis=1) & (xy[0] < size).all(axis=1)
    by_chunk = [bool(seen[table.rows(chunk)].any()) for chunk in range(len(table.boxes))]
    # None that shows anything is left out, and few are there that do not.
    assert set(np.flatnonzero(by_chunk).tolist()) <= set(found)
    assert 0 < sum(by_chunk) <= len(found) < 1.5 * sum(by_chunk) < 0.7 * len(by_chunk)
    center = -cam.cam_from_world[0, :3, :3].T @ cam.cam_from_world[0, :3, 3]
    corners = np.clip(center, table.boxes[:, 0], table.boxes[:, 1])
    away = np.linalg.norm(corners - center, axis=1)
    assert (np.diff(away[found]) >= 0).all()
    within = table.near(cam, reach=1.5, budget=len(memory))
    assert within == [chunk for chunk in found if away[chunk] <= 1.5]
    assert 0 < len(within) < len(found)


def test_the_budget_is_spent_on_the_nearest_and_kept(memory, table):
    cam = seen_by(memory, 0.0, 0.0, 1.5)
    everything = table.near(cam, reach=np.inf, budget=len(memory))
    held = np.diff(table.starts)
    for budget in (0, 50, 500, 2000):
        chosen = table.near(cam, reach=np.inf, budget=budget)
        assert chosen == everything[: len(chosen)]
        assert held[chosen].sum() <= budget < held[everything[: len(chosen) + 1]].sum()


def test_what_lies_behind_is_left_out(memory, table):
    turned = seen_by(memory, 0.0, 0.0, 3.0, rotation=(0.0, np.pi, 0.0))
    found = table.near(turned, reach=1.5, budget=len(memory))
    # The wall at 2 is in view, that at 4 as near.
    assert found and (table.boxes[found, 0, 2] <= 2.0 + 1e-5).all()


def test_a_memory_of_few_points_is_one_chunk_and_a_large_one_no_more_than_a_page_holds():
    one = SpatialMemory(0.1)
    one.fuse(points([(0.0, 0.0, 1.0)]), round=0)
    for memory in (one, SpatialMemory(0.1)):
        chunks = Chunks.of(memory, SIZE, cell=CELL)
        table = ChunkRows.of(memory, chunks)
        assert len(chunks) == 1 and len(table.rows(0)) == len(memory)
        assert len(table.near(camera(), reach=9.0, budget=9)) == len(memory)
    many = SpatialMemory(0.1)
    for round in range(3):
        many.fuse(points(np.random.default_rng(round).uniform(1, 9, (5000, 3))), round=round)
    assert len(Chunks.of(many, 1, cell=CELL)) == 1024 <= MOST_NODES / 3
