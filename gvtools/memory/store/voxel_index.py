"""Voxels and their index: levels of detail, and a two-level hash from voxels to observations.

Space is cut into blocks of 16³ voxels of one edge; blocks of voxels twice, four times, ... as wide
lie beside them. A hash of block coordinates and level gives a block number; each block owns a small
open-addressing table from the voxel's place in the block (12 bits) to the head of a chain of
observations. A frame touches some thousand blocks, so its cost follows the points that arrive, not
the memory that is there, and the tables of one block lie together in the cache.

Far surfaces are stored as coarsely as they were seen: edges double from level to level, so that a
voxel of one level holds eight of the level before it.
"""

# mypy: no-check-untyped-defs

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.kernels import compiled

BLOCK_BITS = 4
LOCAL_MASK = (1 << BLOCK_BITS) - 1
EMPTY_LOCAL = np.uint16(0xFFFF)
EMPTY_KEY = np.int64(-1)
NO_RECORD = np.int32(-1)
COORDINATE_BITS = 20
COORDINATE_OFFSET = 1 << (COORDINATE_BITS - 1)
# A point farther than this many voxels of its level from the origin has no key.
MAX_VOXEL = (COORDINATE_OFFSET - 1) << BLOCK_BITS
# Voxels of level l are 2**l edges wide.
MOST_LEVEL = 7
# Edges within which float32 holds every product of a projection, whatever the points' distance.
VOXEL_RANGE = (1e-25, 1e25)
# The share of a voxel's edge that float64 has to resolve at the origin.
ORIGIN_STEP = 1 / 16
SIZE_CLASSES = 16
SMALLEST_CLASS = 2
# Footprints this much short of a level's belong to it: the ratios of depths are often whole
# numbers, and rounding must not tell to which level a surface goes.
SLACK = 2.0**-10


@dataclass(frozen=True)
class VoxelLevels:
    """The levels of voxels for what was seen how finely."""

    # Of the finest voxels, scene units.
    edge: float
    # Voxels are at most so many footprints of what they hold wide, or the finest there are; 0 for
    # the finest alone.
    voxels_per_footprint: float = 0.0

    @property
    def per_spacing(self) -> float:
        """What spacings are multiplied with to tell their level, see ``level_of``."""
        return self.voxels_per_footprint / self.edge * (1 + SLACK)

    def of(self, spacing: NDArray[np.float32]) -> NDArray[np.uint8]:
        """(N,) levels of points by their spacing (N,)."""
        levels = np.empty(len(spacing), np.uint8)
        _levels(spacing, self.per_spacing, levels)
        return levels


def levels_above(level: NDArray[np.uint8], edges: float) -> NDArray[np.int64]:
    """Doublings by which voxels (N,) are wider than cells of ``edges`` finest edges, at least 0."""
    return np.maximum(level.astype(np.int64) - int(np.floor(np.log2(max(edges, 1.0)))), 0)


@compiled(inline="always")
def level_of(spacing, per_spacing):
    """The level of a spacing: 0 below twice the finest edge, 1 below four times, and so on."""
    ratio = spacing * per_spacing
    level = 0
    while ratio >= 2 and level < MOST_LEVEL:
        ratio *= 0.5
        level += 1
    return level


@compiled()
def _levels(spacing, per_spacing, levels):
    for i in range(len(spacing)):
        levels[i] = level_of(np.float64(spacing[i]), per_spacing)


class IndexArrays(NamedTuple):
    """The index as kernels take it, see VoxelIndex."""

    keys: NDArray[np.int64]
    ids: NDArray[np.int32]
    pool_local: NDArray[np.uint16]
    pool_head: NDArray[np.int32]
    pool_state: NDArray[np.int64]
    block_offset: NDArray[np.int64]
    block_log2: NDArray[np.uint8]
    block_count: NDArray[np.int32]


@compiled(inline="always")
def _hash(key, mask):
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((mixed ^ (mixed >> np.uint64(29))) & np.uint64(mask))


@compiled(inline="always")
def block_key(bx, by, bz, level):
    """int64 key of the block with integer coordinates (bx, by, bz) at a level."""
    return (
        (np.int64(level) << (3 * COORDINATE_BITS))
        | (np.int64(bx + COORDINATE_OFFSET) << (2 * COORDINATE_BITS))
        | (np.int64(by + COORDINATE_OFFSET) << COORDINATE_BITS)
        | np.int64(bz + COORDINATE_OFFSET)
    )


@compiled(inline="always")
def voxel_key(p, inverse_edge, level):
    """(block key, place in the block) of a point (3,); EMPTY_KEY when it is out of reach."""
    x = np.floor(np.float64(p[0]) * inverse_edge)
    y = np.floor(np.float64(p[1]) * inverse_edge)
    z = np.floor(np.float64(p[2]) * inverse_edge)
    if not (abs(x) < MAX_VOXEL and abs(y) < MAX_VOXEL and abs(z) < MAX_VOXEL):
        return EMPTY_KEY, np.uint16(0)
    ix = np.int64(x)
    iy = np.int64(y)
    iz = np.int64(z)
    local = (
        ((ix & LOCAL_MASK) << (2 * BLOCK_BITS))
        | ((iy & LOCAL_MASK) << BLOCK_BITS)
        | (iz & LOCAL_MASK)
    )
    key = block_key(ix >> BLOCK_BITS, iy >> BLOCK_BITS, iz >> BLOCK_BITS, level)
    return key, np.uint16(local)


@compiled()
def find_block(keys, ids, key):
    """The block number of ``key``, or -1."""
    mask = len(keys) - 1
    slot = _hash(key, mask)
    while keys[slot] != EMPTY_KEY:
        if keys[slot] == key:
            return ids[slot]
        slot = (slot + 1) & mask
    return np.int32(-1)


@compiled()
def insert_blocks(keys, ids, count, wanted, out):
    """Give each key of ``wanted`` (n,) its block number, new ones counting up from ``count``.

    Stops early when the table is half full; returns (keys done, blocks now known).
    """
    mask = len(keys) - 1
    limit = len(keys) // 2
    last_key = EMPTY_KEY
    last_id = np.int32(-1)
    for i in range(len(wanted)):
        key = wanted[i]
        if key == last_key:
            out[i] = last_id
            continue
        slot = _hash(key, mask)
        while keys[slot] != EMPTY_KEY and keys[slot] != key:
            slot = (slot + 1) & mask
        if keys[slot] == EMPTY_KEY:
            if count >= limit:
                return i, count
            keys[slot] = key
            ids[slot] = count
            count += 1
        last_key = key
        last_id = ids[slot]
        out[i] = last_id
    return len(wanted), count


@compiled()
def _rehash(old_keys, old_ids, keys, ids):
    mask = len(keys) - 1
    for i in range(len(old_keys)):
        if old_keys[i] != EMPTY_KEY:
            slot = _hash(old_keys[i], mask)
            while keys[slot] != EMPTY_KEY:
                slot = (slot + 1) & mask
            keys[slot] = old_keys[i]
            ids[slot] = old_ids[i]


@compiled()
def group_by_block(blocks, total):
    """Points by block, in the order of first points: (touched blocks, start of each, order)."""
    counts = np.zeros(total, np.int32)
    for b in blocks:
        counts[b] += 1
    rank = np.full(total, -1, np.int32)
    touched = np.empty(min(len(blocks), total), np.int32)
    starts = np.empty(min(len(blocks), total) + 1, np.int64)
    n = 0
    at = np.int64(0)
    for b in blocks:
        if rank[b] < 0:
            rank[b] = n
            touched[n] = b
            starts[n] = at
            at += counts[b]
            n += 1
    starts[n] = at
    cursor = starts[:n].copy()
    order = np.empty(len(blocks), np.int64)
    for i in range(len(blocks)):
        r = rank[blocks[i]]
        order[cursor[r]] = i
        cursor[r] += 1
    return touched[:n], starts[: n + 1], order


@compiled(inline="always")
def _local_slot(local, log2):
    return (np.int64(local) * np.int64(40503) >> 4) & ((np.int64(1) << log2) - 1)


@compiled()
def find_voxel(pool_local, offset, log2, local):
    """Pool position of the voxel ``local`` of a block, or -1."""
    if log2 == 0:
        return np.int64(-1)
    mask = (np.int64(1) << log2) - 1
    slot = _local_slot(local, log2)
    while pool_local[offset + slot] != EMPTY_LOCAL:
        if pool_local[offset + slot] == local:
            return offset + slot
        slot = (slot + 1) & mask
    return np.int64(-1)


@compiled()
def insert_voxel(index, block, local):
    """Pool position of the voxel ``local`` of ``block``, made (with NO_RECORD) when it is new.

    The block's table doubles when three quarters full; tables given up are reused by size class:
    ``pool_state[0]`` is the end of the pool, ``pool_state[c]`` the first free table of 2**c.
    """
    pool_local, pool_head, pool_state = index.pool_local, index.pool_head, index.pool_state
    block_offset, block_log2 = index.block_offset, index.block_log2
    block_count = index.block_count
    log2 = np.int64(block_log2[block])
    offset = block_offset[block]
    if log2 > 0:
        found = find_voxel(pool_local, offset, log2, local)
        if found >= 0:
            return found
    if log2 == 0 or 4 * (block_count[block] + 1) > 3 * (np.int64(1) << log2):
        bigger = max(log2 + 1, SMALLEST_CLASS)
        size = np.int64(1) << bigger
        target = pool_state[bigger]
        if target >= 0:
            low = np.int64(pool_head[target]) & np.int64(0xFFFFFFFF)
            high = np.int64(pool_head[target + 1])
            pool_state[bigger] = (high << 32) | low
        else:
            target = pool_state[0]
            pool_state[0] += size
        for i in range(target, target + size):
            pool_local[i] = EMPTY_LOCAL
            pool_head[i] = NO_RECORD
        if log2 > 0:
            mask = size - 1
            for i in range(offset, offset + (np.int64(1) << log2)):
                if pool_local[i] != EMPTY_LOCAL:
                    slot = _local_slot(pool_local[i], bigger)
                    while pool_local[target + slot] != EMPTY_LOCAL:
                        slot = (slot + 1) & mask
                    pool_local[target + slot] = pool_local[i]
                    pool_head[target + slot] = pool_head[i]
            # The freed table's first two heads hold the 64-bit link of its size class.
            pool_head[offset] = np.int32(pool_state[log2] & np.int64(0xFFFFFFFF))
            pool_head[offset + 1] = np.int32(pool_state[log2] >> 32)
            pool_state[log2] = offset
        block_offset[block] = target
        block_log2[block] = bigger
        offset = target
        log2 = bigger
    mask = (np.int64(1) << log2) - 1
    slot = _local_slot(local, log2)
    while pool_local[offset + slot] != EMPTY_LOCAL:
        slot = (slot + 1) & mask
    pool_local[offset + slot] = local
    block_count[block] += 1
    return offset + slot


@compiled()
def voxel_keys(positions, levels, inverse_edge, keys, locals_):
    """Block key and place in the block of each point; EMPTY_KEY when it is out of reach."""
    outside = 0
    for i in range(len(positions)):
        level = np.int64(levels[i])
        keys[i], locals_[i] = voxel_key(positions[i], inverse_edge / (1 << level), level)
        outside += keys[i] == EMPTY_KEY
    return outside


@compiled()
def link_records(locals_, index, blocks, next_):
    """Rebuild the voxel chains of records in their order (after loading or forgetting)."""
    for i in range(len(locals_)):
        slot = insert_voxel(index, blocks[i], locals_[i])
        next_[i] = index.pool_head[slot]
        index.pool_head[slot] = i


class VoxelIndex:
    """The hash's arrays and their growth; the numba kernels of fusion write into them."""

    def __init__(self) -> None:
        self.keys: NDArray[np.int64] = np.full(1024, EMPTY_KEY, np.int64)
        self.ids: NDArray[np.int32] = np.full(1024, -1, np.int32)
        self.blocks = 0
        # Voxels that hold something, as fusion counts them.
        self.voxels = 0
        # The highest level of any voxel.
        self.top = 0
        self.block_offset: NDArray[np.int64] = np.zeros(512, np.int64)
        self.block_log2: NDArray[np.uint8] = np.zeros(512, np.uint8)
        self.block_count: NDArray[np.int32] = np.zeros(512, np.int32)
        self.pool_local: NDArray[np.uint16] = np.empty(4096, np.uint16)
        self.pool_head: NDArray[np.int32] = np.empty(4096, np.int32)
        self.pool_state: NDArray[np.int64] = np.full(SIZE_CLASSES, -1, np.int64)
        self.pool_state[0] = 0

    @property
    def arrays(self) -> IndexArrays:
        """What kernels read and write."""
        return IndexArrays(*(getattr(self, name) for name in IndexArrays._fields))

    @property
    def nbytes(self) -> int:
        """Bytes in use (spare capacity that was never touched is not counted)."""
        per_block = self.block_offset.itemsize + 1 + self.block_count.itemsize
        return (
            self.keys.nbytes
            + self.ids.nbytes
            + self.blocks * per_block
            + int(self.pool_state[0]) * (self.pool_local.itemsize + self.pool_head.itemsize)
        )

    def block_numbers(self, keys: NDArray[np.int64]) -> NDArray[np.int32]:
        """The block number of each key (n,); unknown blocks are added.

        Consecutive equal keys cost one comparison, so a picture's scan order is cheap.
        """
        out = np.empty(len(keys), np.int32)
        done = 0
        while True:
            step, self.blocks = insert_blocks(
                self.keys, self.ids, self.blocks, keys[done:], out[done:]
            )
            done += step
            if done == len(keys):
                break
            self._grow_table()
        self._grow_blocks()
        return out

    def reserve_voxels(self, count: int, touched: NDArray[np.int32]) -> None:
        """Make room in the pool for ``count`` further voxels in the blocks ``touched``."""
        # A block of m voxels ends in a table of at most 8/3·m + 4 entries, and the tables that it
        # outgrew on the way sum to no more than that again.
        known = int(self.block_count[touched].sum())
        used = int(self.pool_state[0])
        need = used + 6 * (count + known) + 8 * len(touched)
        if need > len(self.pool_head):
            size = max(need, 2 * len(self.pool_head))
            self.pool_local = extend(self.pool_local, size, used)
            self.pool_head = extend(self.pool_head, size, used)

    def _grow_table(self) -> None:
        keys = np.full(2 * len(self.keys), EMPTY_KEY, np.int64)
        ids = np.full(2 * len(self.ids), -1, np.int32)
        _rehash(self.keys, self.ids, keys, ids)
        self.keys, self.ids = keys, ids

    def _grow_blocks(self) -> None:
        old = len(self.block_offset)
        if self.blocks > old:
            size = max(self.blocks, 2 * old)
            self.block_offset = extend(self.block_offset, size, old)
            self.block_log2 = extend(self.block_log2, size, old)
            self.block_count = extend(self.block_count, size, old)
            for array in (self.block_offset, self.block_log2, self.block_count):
                array[old:] = 0


def check_grid(voxel: float, origin: NDArray[np.float64]) -> None:
    """Refuse voxels that the numbers cannot hold."""
    least, most = VOXEL_RANGE
    if not least <= voxel <= most:
        raise OptionError(
            f"voxel edge {voxel}; expected a positive length in scene units, {least:g} to {most:g}"
        )
    step = float(np.spacing(np.abs(origin).max()))
    if step > ORIGIN_STEP * voxel:
        raise OptionError(
            f"voxel edge {voxel:g} at the origin {origin.tolist()}, where positions are multiples "
            f"of {step:g}; move the scene nearer to 0 or take an edge of {step / ORIGIN_STEP:g}"
        )


def rounded_origin(middle: NDArray[np.float64], voxel: float) -> NDArray[np.float64]:
    """``middle`` (3,) in whole scene units, which keep the decimals of the world frame as they are.

    The step is smaller where float32 would lose a 64th of a voxel half a step away.
    """
    step = min(1.0, 2.0 ** np.floor(np.log2(voxel) + 18))
    return np.rint(middle / step) * step


def extend(array: NDArray, size: int, used: int) -> NDArray:
    """A longer array with the first ``used`` rows of ``array``; the rest is never touched."""
    bigger = np.empty((size, *array.shape[1:]), array.dtype)
    bigger[:used] = array[:used]
    return bigger
