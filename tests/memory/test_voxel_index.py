from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gvtools.memory.store.voxel_index import (
    COORDINATE_OFFSET,
    MOST_LEVEL,
    NO_RECORD,
    VoxelIndex,
    block_key,
    extended,
    find_block,
    find_voxel,
    insert_voxel,
)


def test_block_keys_are_unique_and_not_negative():
    far = COORDINATE_OFFSET - 1
    axis = (-far, -2, -1, 0, 1, 7, far)
    keys = {
        int(block_key(x, y, z, level))
        for x in axis for y in axis for z in axis for level in (0, 1, MOST_LEVEL)
    }  # fmt: skip
    assert len(keys) == 3 * len(axis) ** 3
    assert min(keys) >= 0


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
        count = int(rng.integers(1, 3000))
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


def test_an_empty_block_holds_nothing():
    index = VoxelIndex()
    index.block_numbers(np.array([3], np.int64))
    assert find_voxel(index.pool_local, np.int64(0), np.int64(0), np.uint16(0)) == -1
    assert index.voxels == 0


def test_longer_arrays_keep_what_was_used():
    array = np.arange(12).reshape(6, 2)
    longer = extended(array, 9, 4)
    assert longer.shape == (9, 2)
    np.testing.assert_array_equal(longer[:4], array[:4])
