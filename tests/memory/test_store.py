"""The store is an Open3D point cloud: shared memory, growth, and Open3D's operations on it."""

from __future__ import annotations

import copy
from collections import defaultdict

import numpy as np
import open3d as o3d
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera, plane_view, random_memory, random_points

from gvtools.errors import DegenerateError, OptionError, ShapeError
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory, TiledMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.store import tile_set
from gvtools.memory.store.observations import ATTRIBUTES
from gvtools.memory.store.tile import DOUBLINGS, thinned_copy
from gvtools.memory.store.tile_set import FAR, ROOT, WHOLE, Octree, TileSet, cell_keys
from gvtools.memory.store.voxel_index import (
    NO_RECORD,
    VoxelIndex,
    VoxelLevels,
    find_block,
    find_voxel,
    insert_voxel,
    voxel_keys,
)

SIZE = {"width": 40, "height": 30, "focal": 40}


def _attribute(memory: SpatialMemory, name: str) -> np.ndarray:
    return memory.cloud.point[name].numpy()


def test_the_cloud_holds_every_attribute_in_the_memory_that_kernels_write():
    memory = random_memory(3)
    arrays = memory.columns.arrays
    for name in ATTRIBUTES:
        found = _attribute(memory, name)
        ours = arrays.view_row if name == "view" else getattr(arrays, name)
        assert np.shares_memory(found, ours), name
        assert found.shape == (len(memory), 3 if name in ("positions", "colors") else 1)
    world = memory.frame.to_world(_attribute(memory, "positions"))
    np.testing.assert_array_equal(world, memory.positions)
    view = _attribute(memory, "view")[:, 0]
    np.testing.assert_array_equal(_attribute(memory, "round")[:, 0], memory.views.round[view])
    for expected in (memory.generated, memory.views.generated[view]):
        np.testing.assert_array_equal(_attribute(memory, "generated")[:, 0], expected)


def test_growth_keeps_what_is_there_and_a_cloud_of_before_stays_whole():
    memory = SpatialMemory(0.02)
    memory.observe(*_frame(2.0), round=0)
    cloud, count = memory.cloud, len(memory)
    before = cloud.point.positions.numpy().copy()
    for number in range(1, 4):
        memory.observe(*_frame(2.0 + number), round=number)
    assert len(memory) == 4 * count
    np.testing.assert_array_equal(_attribute(memory, "positions")[:count], before)
    np.testing.assert_array_equal(cloud.point.positions.numpy(), before)
    for number in (3, 1):
        memory.forget(round=number)
    assert set(_attribute(memory, "round")[:, 0].tolist()) == {0, 2}
    assert np.shares_memory(_attribute(memory, "spacing"), memory.columns.arrays.spacing)


def _frame(depth: float):
    rgb = np.full((30, 40, 3), 90, np.uint8)
    return rgb, np.full((30, 40), depth, np.float32), camera(**SIZE)


def test_observing_is_lifting_and_fusing():
    one, two = SpatialMemory(0.05), SpatialMemory(0.05)
    report = one.observe(*_frame(2.0), round=0, mask=np.arange(1200).reshape(30, 40) % 2 == 0)
    assert report.dropped["masked"] == 600 and report.added == len(one) > 0
    assert one.observe(*_frame(3.0), round=1, generated=True).rejected_free == 0
    whole = two.observe(*_frame(2.0), round=0)
    lifted = plane_view(camera(**SIZE), 2.0)
    assert whole.points == len(lifted) and not whole.dropped["masked"]
    assert (report + whole).dropped["masked"] == 600


def test_a_memory_of_its_own_cloud_is_the_same_memory():
    memory = random_memory(4, options=MemoryOptions(observations_per_voxel=1))
    again = SpatialMemory.from_point_cloud(
        memory.cloud, voxel=memory.voxel, frame=memory.frame, options=memory.options
    )
    assert again.voxels <= memory.voxels and again.rounds == memory.rounds
    place = {tuple(p): i for i, p in enumerate(memory.columns.positions.tolist())}
    rows = [place.get(tuple(p), -1) for p in again.columns.positions.tolist()]
    assert np.mean(np.array(rows) >= 0) > 0.8
    found = [i for i, row in enumerate(rows) if row >= 0]
    for name in ("colors", "round", "generated"):
        np.testing.assert_array_equal(
            getattr(again.columns, name)[found],
            getattr(memory.columns, name)[[rows[i] for i in found]],
        )


def test_a_bare_cloud_takes_its_spacing_from_its_neighbours():
    x, y = np.meshgrid(np.arange(30) * 0.1, np.arange(20) * 0.1)
    where = np.stack([x.ravel() + 1e6, y.ravel(), np.full(600, 2.0)], axis=1)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(where))
    with pytest.raises(ShapeError, match="no colours"):
        SpatialMemory.from_point_cloud(cloud)
    cloud.point.colors = o3d.core.Tensor(np.zeros((600, 2), np.float32))
    with pytest.raises(ShapeError, match="colors has shape"):
        SpatialMemory.from_point_cloud(cloud)
    cloud.point.colors = o3d.core.Tensor(np.full((600, 3), 0.5, np.float32))
    assert SpatialMemory.from_point_cloud(cloud).voxel == pytest.approx(0.1)
    memory = SpatialMemory.from_point_cloud(cloud, voxel=0.04)
    assert len(memory) == 600
    np.testing.assert_allclose(memory.columns.spacing, 0.1, rtol=1e-6)
    assert set(memory.columns.colors.ravel().tolist()) == {128}
    np.testing.assert_allclose(memory.positions[:, 2], 2, atol=1e-6)
    one = o3d.t.geometry.PointCloud(o3d.core.Tensor(where[:1]))
    one.point.colors = o3d.core.Tensor(np.zeros((1, 3), np.uint8))
    with pytest.raises(DegenerateError, match="1 distinct points"):
        SpatialMemory.from_point_cloud(one)


def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(OptionError, match=r"memory device 'moon'; expected 'cpu'"):
        SpatialMemory(0.1, device="moon")
    if not torch.cuda.is_available():
        with pytest.raises(OptionError, match="where Open3D finds CUDA"):
            random_memory(1).to("cuda:0")


def test_a_deep_copy_and_a_recoloured_one_leave_the_memory_alone():
    memory = random_memory(3)
    colors = memory.columns.colors.copy()
    whole = copy.deepcopy(memory)
    painted = memory.recolored(np.zeros_like(colors))
    assert not painted.columns.colors.any()
    assert np.shares_memory(painted.columns.positions, memory.columns.positions)
    whole.forget(round=memory.rounds[-1])
    whole.columns.arrays.positions[:] = 0
    np.testing.assert_array_equal(memory.columns.colors, colors)
    assert len(whole) < len(memory) and memory.columns.positions.any()


def test_a_copy_by_to_grows_apart_from_its_original():
    memory = random_memory(3)
    before, voxels = len(memory), memory.voxels
    own = memory.own_confidence()
    other = memory.to("cpu")
    assert repr(other) == repr(memory)
    target = memory.views[0].camera
    np.testing.assert_array_equal(other.project(target).rgb, memory.project(target).rgb)
    for number in range(4, 8):
        other.observe(*_frame(2.0 + number), round=number)
    assert (len(memory), memory.voxels) == (before, voxels) and len(other) > before
    np.testing.assert_array_equal(memory.own_confidence(), own)
    memory.observe(*_frame(1.5), round=9)
    memory.forget(round=9)
    assert (len(memory), memory.voxels) == (before, voxels)


def test_float_colours_are_those_of_the_photograph_and_others_are_refused():
    rgb, depth, view = _frame(2.0)
    of_bytes, of_floats = SpatialMemory(0.02), SpatialMemory(0.02)
    of_bytes.observe(rgb, depth, view, round=0)
    of_floats.observe(rgb / np.float32(255), depth, view, round=0)
    np.testing.assert_array_equal(_attribute(of_bytes, "colors"), _attribute(of_floats, "colors"))
    for wrong in (rgb.astype(np.float32) + 2, rgb.astype(np.int64), np.full(rgb.shape, np.nan)):
        with pytest.raises(ShapeError, match="expected uint8, or float from 0 to 1"):
            of_bytes.observe(wrong, depth, view, round=1)
    with pytest.raises(ShapeError, match="no depth; expected"):
        of_bytes.observe(rgb, None, view, round=1)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), batches=st.integers(1, 5))
def test_blocks_are_numbered_like_a_dictionary_would(seed, batches):
    """Also across growth: the table starts with room for 512 blocks."""
    rng = np.random.default_rng(seed)
    index = VoxelIndex()
    known: dict[int, int] = {}
    for _ in range(batches):
        keys = rng.integers(0, 900, 700) * 1_000_003
        expected = [known.setdefault(key, len(known)) for key in keys.tolist()]
        np.testing.assert_array_equal(index.block_numbers(keys), expected)
    assert index.blocks == len(known)
    for key, number in known.items():
        assert find_block(index.keys, index.ids, np.int64(key)) == number
    assert find_block(index.keys, index.ids, np.int64(5)) == -1
    assert len(index.block_offset) >= index.blocks


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), blocks=st.integers(1, 30))
def test_voxels_are_found_again_and_stay_within_the_reserve(seed, blocks):
    """Blocks grow interleaved, so that tables that were given up are used again."""
    rng = np.random.default_rng(seed)
    index = VoxelIndex()
    numbers = index.block_numbers(np.arange(blocks, dtype=np.int64))
    known: dict[tuple[int, int], int] = {}
    for _ in range(4):
        count = int(rng.integers(1, 1500))
        block = rng.integers(0, blocks, count)
        place = rng.integers(0, 4096, count)
        index.reserve_voxels(count, np.unique(numbers[block]))
        arrays = index.arrays
        for b, p in zip(block.tolist(), place.tolist(), strict=True):
            slot = insert_voxel(arrays, np.int32(b), np.uint16(p))
            expected = known.setdefault((b, p), len(known))
            if expected == len(known) - 1 and index.pool_head[slot] == NO_RECORD:
                index.pool_head[slot] = expected
            assert index.pool_head[slot] == expected
        assert index.pool_state[0] <= len(index.pool_head) == len(index.pool_local)
    assert index.block_count[:blocks].sum() == len(known)
    for (b, p), number in known.items():
        slot = find_voxel(
            index.pool_local, index.block_offset[b], np.int64(index.block_log2[b]), np.uint16(p)
        )
        assert index.pool_head[slot] == number
    tables = sum(1 << int(log2) for log2 in index.block_log2[:blocks])
    assert tables <= 3 * len(known) + 8 * blocks  # no table is less than three eighths full


VOXEL = 0.01


def keys_at(positions, level):
    keys, places = np.empty(len(positions), np.int64), np.empty(len(positions), np.uint16)
    voxel_keys(positions, np.full(len(positions), level, np.uint8), 1 / VOXEL, keys, places)
    return list(zip(keys.tolist(), places.tolist(), strict=True))


def test_a_voxel_of_any_level_lies_in_one_cell():
    positions = np.random.default_rng(0).uniform(-4, 4, (4000, 3)).astype(np.float32)
    cells = cell_keys(positions, VOXEL)
    for level in range(8):
        cell_of: dict[tuple[int, int], int] = {}
        for voxel, cell in zip(keys_at(positions, level), cells.tolist(), strict=True):
            assert cell_of.setdefault(voxel, cell) == cell


def test_new_tiles_are_as_large_as_divided_ones_in_proportion_to_their_voxels():
    tree, levels = Octree(), VoxelLevels(VOXEL, 1.0)
    tree.divided.add(WHOLE)
    tree.usual = 2
    positions = np.array([[3, 3, 3], [300, 300, 300]], np.float32)
    spacing = np.array([VOXEL, 8.5 * VOXEL], np.float32)
    _, made = tree.tiles_of(positions, spacing, levels, free=0)
    assert [node[0] for node in made] == [2, 5]
    assert all(node[0] < ROOT for node in made)


def test_points_beyond_all_cells_have_a_tile():
    tree = Octree()
    positions = np.array([[1e8, 0, 0]], np.float32)
    spacing = np.full(1, 50.0, np.float32)
    _, made = tree.tiles_of(positions, spacing, VoxelLevels(VOXEL, 1.0), free=0)
    assert made == [FAR]


@pytest.mark.parametrize("doublings", DOUBLINGS)
def test_each_segment_keeps_one_observation_a_cube(doublings):
    memory = SpatialMemory(0.02)
    for i in range(3):
        memory.fuse(random_points(np.random.default_rng(i), 250, name=f"{i}"), round=0)
    copy = thinned_copy(memory.whole, doublings)
    columns, segments = memory.columns, memory.segments
    assert copy.start[-1] == len(copy.rows.positions) < len(memory)
    for s in range(segments.count):
        first, length = segments.start[s], segments.length[s]
        cubes = defaultdict(list)
        for row in range(first, first + length):
            edge = 0.02 * 2.0 ** columns.level[row]
            voxel = np.floor(columns.positions[row].astype(float) * (1 / edge)).astype(int)
            cubes[tuple((voxel >> doublings).tolist())].append(row)
        rows = slice(copy.start[s], copy.start[s + 1])
        assert rows.stop - rows.start == len(cubes)
        for k, members in enumerate(cubes.values()):
            weight = columns.confidence[members].astype(float)
            mean = np.average(columns.positions[members], axis=0, weights=weight)
            np.testing.assert_allclose(copy.rows.positions[rows][k], mean, rtol=1e-5, atol=1e-6)
            spacing = np.average(columns.spacing[members], weights=weight)
            edge = 0.02 * 2.0 ** columns.level[members[0]] * 2**doublings
            assert copy.rows.spacing[rows][k] == pytest.approx(max(spacing, edge), rel=1e-5)
            assert copy.rows.confidence[rows][k] == columns.confidence[members].max()


def test_far_tiles_are_drawn_from_thinned_copies(tmp_path, monkeypatch):
    monkeypatch.setattr(tile_set, "SMALLEST", 1)
    memory = TiledMemory(0.01, options=MemoryOptions(budget="1MB"), scratch=tmp_path)
    source = camera(width=160, height=120, focal=150)
    color = np.zeros((120, 160, 3), np.uint8)
    color[..., 0] = np.linspace(50, 200, 160)
    for x in (-0.5, 0.0, 0.5):
        near = camera(width=160, height=120, focal=150, center=(x, 0, 0))
        memory.fuse(plane_view(near, 2.0, color=color), round=0)
    assert not memory.in_ram
    drawn = []
    gathered = TileSet.gather

    def counted(self, segments, chosen, **options):
        found = gathered(self, segments, chosen, **options)
        drawn.append(len(found.columns.positions))
        return found

    monkeypatch.setattr(TileSet, "gather", counted)
    far = camera(width=160, height=120, focal=150, center=(0, 0, -8))
    whole = memory.project(far)
    every, drawn[:] = sum(drawn), []
    thin = memory.project(far, options=SplatOptions(far_detail_px=1.0))
    assert sum(drawn) < every / 5
    both = whole.valid & thin.valid
    assert both.sum() > 0.9 * whole.valid.sum() > 100
    assert np.abs(whole.rgb - thin.rgb)[both].mean() < 0.02
    np.testing.assert_allclose(thin.depth[both], whole.depth[both], rtol=0.01)
    drawn[:] = []
    memory.project(source, options=SplatOptions(far_detail_px=1.0))
    close = memory.project(source)
    assert close.coverage > 0.9
