"""The fusion kernel: points of one view into voxels, one observation per voxel and direction.

A voxel keeps a chain of observations. The view's own points in a voxel are averaged by
confidence. The average then joins the chain: it merges with an observation seen from almost the
same direction at no finer detail (agreement raises the confidence), or with the most similar one
once the chain is full, and stands beside the others otherwise. Generated content enters no place
where a voxel of any level holds observed content.
"""

# mypy: no-check-untyped-defs

from __future__ import annotations

import numpy as np

from gvtools.kernels import compiled
from gvtools.memory.store.voxel_index import (
    EMPTY_KEY,
    NO_RECORD,
    find_block,
    find_voxel,
    insert_voxel,
    voxel_key,
)

# Rows of the kernel's report.
ADDED, MERGED, AGREED, REJECTED_OBSERVED, NEW_VOXELS, MERGED_POINTS, FIRST_RUN = range(7)
REPORT_SIZE = 7


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
def group_by_block(blocks, total):
    """Counting sort of the points by block, blocks in the order of their first point.

    Returns (touched blocks, start of each in the order, order).
    """
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


@compiled(fastmath={"nsz", "arcp", "contract"})
def _most_similar(
    head, p, spacing, center, view_centers, view_generated, generated, r_view, r_spacing, r_next
):
    """The chain's observation seen from the most similar direction: (record, cosine, length).

    Generated content never stands in for observed content: observed points pass it by.
    """
    ax = center[0] - p[0]
    ay = center[1] - p[1]
    az = center[2] - p[2]
    norm_a = ax * ax + ay * ay + az * az
    best = NO_RECORD
    best_score = -2.0
    best_cosine = -2.0
    length = 0
    m = head
    while m != NO_RECORD:
        if view_generated[r_view[m]] and not generated:
            m = r_next[m]
            continue
        length += 1
        c = view_centers[r_view[m]]
        bx = c[0] - p[0]
        by = c[1] - p[1]
        bz = c[2] - p[2]
        norm = norm_a * (bx * bx + by * by + bz * bz)
        cosine = (ax * bx + ay * by + az * bz) / np.sqrt(norm) if norm > 0 else 1.0
        # An observation of much finer or coarser detail is less alike than one of the same.
        ratio = r_spacing[m] / spacing
        if ratio < 1:
            ratio = 1 / ratio
        score = cosine - 0.01 * (ratio - 1)
        if score > best_score:
            best_score = score
            best_cosine = cosine
            best = m
        m = r_next[m]
    return best, best_cosine, length


@compiled()
def fuse_blocks(
    positions, colors, confidence, spacing, levels, locals_, touched, starts, order,
    keys, ids, pool_local, pool_head, pool_state, block_offset, block_log2, block_count, top,
    r_x, r_y, r_z, r_color, r_confidence, r_spacing, r_view, r_level, r_next, count,
    view, center, view_centers, view_round, view_generated,
    cosine_same, finer, capacity, weight_cap, inverse_edge,
    old_start, old_box, run_start, run_count, run_box, agreed_record, agreed_weight, report,
):  # fmt: skip
    """Fuse one view's points, grouped by block; returns (records, runs, agreements).

    New records are appended block by block, so each (block, view) is one contiguous run with a
    tight bounding box (``run_box``: min xyz, max xyz, largest spacing). Records of earlier rounds
    are never changed: what agrees with one is logged as (record, confidence). ``old_start`` and
    ``old_box`` are those of the runs that were there before, ``report[FIRST_RUN]`` the first of
    these that has changed; ``inverse_edge`` is of level 0, and ``top`` the highest level that the
    memory holds with these points.
    """
    largest = 0
    for g in range(len(touched)):
        largest = max(largest, starts[g + 1] - starts[g])
    t_sum = np.empty((largest, 6), np.float64)
    t_weight = np.empty(largest, np.float64)
    t_spacing = np.empty(largest, np.float64)
    t_best = np.empty(largest, np.float32)
    t_points = np.empty(largest, np.int32)
    t_slot = np.empty(largest, np.int64)
    t_head = np.empty(largest, np.int32)
    t_first = np.empty(largest, np.int64)
    p = np.empty(3, np.float64)
    # Where the point, and what it merged with, is kept.
    at = np.empty(3, np.float32)
    moved = np.empty(3, np.float32)
    runs = 0
    agreed = 0
    merged_into = 0
    generated = view_generated[view]
    for g in range(len(touched)):
        block = touched[g]
        level = np.int64(levels[order[starts[g]]])
        inverse = inverse_edge / (1 << level)
        n = 0
        for o in range(starts[g], starts[g + 1]):
            i = order[o]
            log2 = block_log2[block]
            slot = insert_voxel(
                pool_local, pool_head, pool_state, block_offset, block_log2, block_count, block,
                locals_[i],
            )  # fmt: skip
            if block_log2[block] != log2:
                # The block's table moved: find the voxels of this view again.
                for t in range(n):
                    t_slot[t] = -1
                _relocate(pool_head, block_offset[block], block_log2[block], t_slot)
            head = pool_head[slot]
            w = np.float64(confidence[i])
            if head <= -2:
                t = -2 - head
            else:
                t = n
                n += 1
                pool_head[slot] = -2 - t
                t_slot[t] = slot
                t_head[t] = head
                t_first[t] = i
                t_weight[t] = 0
                t_spacing[t] = 0
                t_best[t] = 0
                t_points[t] = 0
                for k in range(6):
                    t_sum[t, k] = 0
            for k in range(3):
                t_sum[t, k] += w * positions[i, k]
                t_sum[t, 3 + k] += w * colors[i, k]
            t_weight[t] += w
            t_spacing[t] += w * spacing[i]
            t_best[t] = max(t_best[t], confidence[i])
            t_points[t] += 1
        first = count
        for t in range(n):
            slot = t_slot[t]
            head = t_head[t]
            weight = t_weight[t]
            for k in range(3):
                p[k] = t_sum[t, k] / weight
            own = np.float64(t_best[t])
            # Where pixels are finer than voxels, neighbours stand a voxel apart.
            width = max(t_spacing[t] / weight, 1.0 / inverse)
            member = positions[t_first[t]]
            for k in range(3):
                at[k] = _inside(p[k], member[k], inverse)
            if generated and _observed_there(
                head, at, level, top, inverse_edge, keys, ids, pool_local, pool_head,
                block_offset, block_log2, r_view, r_next, view_generated,
            ):  # fmt: skip
                pool_head[slot] = head
                report[REJECTED_OBSERVED] += t_points[t]
                continue
            best, cosine, length = _most_similar(
                head, p, width, center, view_centers, view_generated, generated,
                r_view, r_spacing, r_next,
            )  # fmt: skip
            if best != NO_RECORD and (
                length >= capacity or (cosine >= cosine_same and width >= finer * r_spacing[best])
            ):
                pool_head[slot] = head
                report[MERGED_POINTS] += t_points[t]
                if view_round[r_view[best]] == view_round[view]:
                    report[MERGED] += 1
                    at[0], at[1], at[2] = r_x[best], r_y[best], r_z[best]
                    _merge(
                        best, p, t_sum[t], weight, own, width, view, inverse,
                        r_x, r_y, r_z, r_color, r_confidence, r_spacing, r_view, weight_cap,
                    )  # fmt: skip
                    moved[0], moved[1], moved[2] = r_x[best], r_y[best], r_z[best]
                    if generated and _observed_there(
                        head, moved, level, top, inverse_edge, keys, ids, pool_local, pool_head,
                        block_offset, block_log2, r_view, r_next, view_generated,
                    ):  # fmt: skip
                        r_x[best], r_y[best], r_z[best] = at[0], at[1], at[2]
                    # Neighbours mostly merge into the same run.
                    if old_start[merged_into] > best or (
                        merged_into + 1 < len(old_start) and old_start[merged_into + 1] <= best
                    ):
                        merged_into = int(np.searchsorted(old_start, best, side="right")) - 1
                    _include(old_box[merged_into], r_x[best], r_y[best], r_z[best], r_spacing[best])
                    report[FIRST_RUN] = min(report[FIRST_RUN], merged_into)
                else:
                    report[AGREED] += 1
                    agreed_record[agreed] = best
                    agreed_weight[agreed] = own
                    agreed += 1
                continue
            r_x[count], r_y[count], r_z[count] = at[0], at[1], at[2]
            for k in range(3):
                r_color[count, k] = np.uint8(t_sum[t, 3 + k] / weight + 0.5)
            r_confidence[count] = min(own, weight_cap)
            r_spacing[count] = width
            r_view[count] = view
            r_level[count] = level
            r_next[count] = head
            pool_head[slot] = count
            # A voxel whose points all went elsewhere stays empty.
            report[NEW_VOXELS] += head == NO_RECORD
            report[MERGED_POINTS] += t_points[t] - 1
            count += 1
        if count > first:
            run_start[runs] = first
            run_count[runs] = count - first
            run_box[runs, 0] = r_x[first:count].min()
            run_box[runs, 1] = r_y[first:count].min()
            run_box[runs, 2] = r_z[first:count].min()
            run_box[runs, 3] = r_x[first:count].max()
            run_box[runs, 4] = r_y[first:count].max()
            run_box[runs, 5] = r_z[first:count].max()
            run_box[runs, 6] = r_spacing[first:count].max()
            runs += 1
            report[ADDED] += count - first
    return count, runs, agreed


@compiled(inline="always")
def _inside(value, member, inverse_edge):
    """``value`` as float32, or ``member`` where rounding pushed it out of the member's voxel."""
    rounded = np.float32(value)
    if np.floor(np.float64(rounded) * inverse_edge) != np.floor(np.float64(member) * inverse_edge):
        return np.float32(member)
    return rounded


@compiled()
def _relocate(pool_head, offset, log2, t_slot):
    for slot in range(offset, offset + (np.int64(1) << np.int64(log2))):
        if pool_head[slot] <= -2:
            t_slot[-2 - pool_head[slot]] = slot


@compiled()
def _any_observed(head, r_view, r_next, view_generated):
    m = head
    while m != NO_RECORD:
        if not view_generated[r_view[m]]:
            return True
        m = r_next[m]
    return False


@compiled()
def _head_at(p, level, inverse_edge, keys, ids, pool_local, pool_head, block_offset, block_log2):
    """The head of the chain of a level's voxel around a point; ``inverse_edge`` of level 0."""
    key, local = voxel_key(p, inverse_edge / (1 << level), level)
    if key == EMPTY_KEY:
        return NO_RECORD
    block = find_block(keys, ids, key)
    if block < 0:
        return NO_RECORD
    slot = find_voxel(pool_local, block_offset[block], np.int64(block_log2[block]), local)
    return pool_head[slot] if slot >= 0 else NO_RECORD


@compiled()
def _observed_there(
    head, p, level, top, inverse_edge, keys, ids, pool_local, pool_head, block_offset, block_log2,
    r_view, r_next, view_generated,
):  # fmt: skip
    """Whether a voxel of any level around a point holds observed content; ``head`` is its own."""
    if _any_observed(head, r_view, r_next, view_generated):
        return True
    for other in range(top + 1):
        if other != level and _any_observed(
            _head_at(
                p, other, inverse_edge, keys, ids, pool_local, pool_head, block_offset, block_log2
            ),
            r_view, r_next, view_generated,
        ):  # fmt: skip
            return True
    return False


@compiled()
def _merge(m, p, sums, weight, own, width, view, inverse_edge, r_x, r_y, r_z, r_color,
           r_confidence, r_spacing, r_view, weight_cap):  # fmt: skip
    """Confidence-weighted running mean; the integer view goes to the more confident side."""
    old = np.float64(r_confidence[m])
    share = own / (old + own)
    r_x[m] = _inside(r_x[m] + share * (p[0] - r_x[m]), r_x[m], inverse_edge)
    r_y[m] = _inside(r_y[m] + share * (p[1] - r_y[m]), r_y[m], inverse_edge)
    r_z[m] = _inside(r_z[m] + share * (p[2] - r_z[m]), r_z[m], inverse_edge)
    for k in range(3):
        value = r_color[m, k] + share * (sums[3 + k] / weight - r_color[m, k])
        r_color[m, k] = np.uint8(value + 0.5)
    r_spacing[m] += share * (width - r_spacing[m])
    if own > old:
        r_view[m] = view
    r_confidence[m] = min(old + own, weight_cap)


@compiled(inline="always")
def _include(box, x, y, z, spacing):
    """Widen a run's box to a point that has moved."""
    box[0] = min(box[0], x)
    box[1] = min(box[1], y)
    box[2] = min(box[2], z)
    box[3] = max(box[3], x)
    box[4] = max(box[4], y)
    box[5] = max(box[5], z)
    box[6] = max(box[6], spacing)


@compiled()
def link_records(
    locals_, pool_local, pool_head, pool_state, block_offset, block_log2, block_count,
    blocks, r_next,
):  # fmt: skip
    """Rebuild the voxel chains of records in their order (after loading or forgetting)."""
    for i in range(len(locals_)):
        slot = insert_voxel(
            pool_local, pool_head, pool_state, block_offset, block_log2, block_count, blocks[i],
            locals_[i],
        )  # fmt: skip
        r_next[i] = pool_head[slot]
        pool_head[slot] = i
