from __future__ import annotations

import numpy as np

from gvtools.memory.store.octree import (
    FAR,
    ROOT,
    WHOLE,
    Octree,
    cell_coordinates,
    cell_keys,
    parent,
)
from gvtools.memory.store.voxel_index import VoxelLevels, voxel_keys

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


def test_cells_have_their_coordinates():
    edge = 128 * VOXEL
    positions = np.array([[0.1, 0.1, 0.1], [-0.1, edge + 0.1, 2 * edge + 0.1]], np.float32)
    found = cell_coordinates(cell_keys(positions, VOXEL)) - (1 << 19)
    assert found.tolist() == [[0, 0, 0], [-1, 1, 2]]


def test_tiles_follow_divisions():
    tree, levels = Octree(), VoxelLevels(VOXEL)
    rng = np.random.default_rng(1)
    positions = rng.uniform(0.1, 5.0, (300, 3)).astype(np.float32)
    spacing = np.full(300, VOXEL, np.float32)
    numbers, made = tree.tiles_of(positions, spacing, levels, free=0)
    assert made == [WHOLE] and not numbers.any()
    level = 4
    node = WHOLE
    tree.divide(node)
    while node[0] > level:
        tree.divided.add(node)
        cell = cell_coordinates(cell_keys(positions[:1], VOXEL))[0] >> (node[0] - 1)
        node = (node[0] - 1, *cell.tolist())
    tree.divided.add(node)
    numbers, made = tree.tiles_of(positions, spacing, levels, free=1)
    cells = cell_coordinates(cell_keys(positions, VOXEL)) >> (level - 1)
    assert {n[1:] for n in made} == set(map(tuple, cells.tolist()))
    of = {
        tuple(cell): number for cell, number in zip(cells.tolist(), numbers.tolist(), strict=True)
    }
    assert of == {n[1:]: i for i, n in enumerate(made, 1)}
    families = tree.families()
    assert set(families) == {node} and sorted(families[node]) == sorted(made)
    tree.join(node, made, 50)
    numbers, made = tree.tiles_of(positions, spacing, levels, free=51)
    assert made == [] and set(numbers.tolist()) == {50}


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


def test_eight_parts_have_one_parent():
    assert {parent((3, 4 + i, 6 + j, 8 + k)) for i in (0, 1) for j in (0, 1) for k in (0, 1)} == {
        (4, 2, 3, 4)
    }
