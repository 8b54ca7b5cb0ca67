"""Fusion of one view's points into a memory, and its report.

A voxel keeps a chain of observations. The view's own points in a voxel are averaged by
confidence. The average then joins the chain: it merges with an observation seen from almost the
same direction at no finer detail (agreement raises the confidence), or with the most similar one
once the chain is full, and stands beside the others otherwise. Generated content enters no place
where a voxel of any level holds observed content.
"""

# mypy: no-check-untyped-defs

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ShapeError
from gvtools.kernels import compiled
from gvtools.memory.culling import in_free_space
from gvtools.memory.store.observations import LAST_ROUND, Observations
from gvtools.memory.store.store import Store
from gvtools.memory.store.views import PointSet, SourceView
from gvtools.memory.store.voxel_index import (
    EMPTY_KEY,
    NO_RECORD,
    find_block,
    find_voxel,
    group_by_block,
    insert_voxel,
    voxel_key,
    voxel_keys,
)

# Rows of the kernel's report.
ADDED, AGREED, REJECTED_OBSERVED, NEW_VOXELS, MERGED_POINTS, FIRST_SEGMENT = range(6)
REPORT_SIZE = 6


class Batch(NamedTuple):
    """N points of one view; ``order`` lists those of block ``touched[g]`` from ``starts[g]`` on."""

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    spacing: NDArray[np.float32]
    levels: NDArray[np.uint8]
    locals: NDArray[np.uint16]
    touched: NDArray[np.int32]
    starts: NDArray[np.int64]
    order: NDArray[np.int64]


class FusedView(NamedTuple):
    """The view that is fused, and of all views ``centers`` and whether they are ``scanned``."""

    row: int
    round: int
    generated: bool
    center: NDArray[np.float64]
    centers: NDArray[np.float64]
    scanned: NDArray[np.bool_]


class FusionRules(NamedTuple):
    """MemoryOptions for the kernel; ``inverse_edge`` is of level 0, ``top`` the highest level."""

    cosine_same: float
    min_detail_ratio: float
    capacity: int
    weight_cap: float
    inverse_edge: float
    top: int


class FusionOutput(NamedTuple):
    """New segments (``group``: rows of ``touched``), agreements with earlier rounds, and counts."""

    group: NDArray[np.int32]
    start: NDArray[np.int64]
    length: NDArray[np.int32]
    box: NDArray[np.float32]
    agreed_row: NDArray[np.int32]
    agreed_weight: NDArray[np.float32]
    report: NDArray[np.int64]


@compiled(fastmath={"nsz", "arcp", "contract"})
def _most_similar(head, p, spacing, source, columns):
    """The chain's observation seen from the most similar direction: (record, cosine, length).

    Observed points pass generated content by. A scan's and a camera's observations stand apart.
    """
    center, generated = source.center, source.generated
    scanned = source.scanned[source.row]
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
        if (columns.generated[m] and not generated) or (
            source.scanned[columns.view_row[m]] != scanned
        ):
            m = columns.next[m]
            continue
        length += 1
        c = source.centers[columns.view_row[m]]
        bx = c[0] - p[0]
        by = c[1] - p[1]
        bz = c[2] - p[2]
        norm = norm_a * (bx * bx + by * by + bz * bz)
        cosine = (ax * bx + ay * by + az * bz) / np.sqrt(norm) if norm > 0 else 1.0
        # An observation of much finer or coarser detail is less alike than one of the same.
        ratio = columns.spacing[m] / spacing
        if ratio < 1:
            ratio = 1 / ratio
        score = cosine - 0.01 * (ratio - 1)
        if score > best_score:
            best_score = score
            best_cosine = cosine
            best = m
        m = columns.next[m]
    return best, best_cosine, length


@compiled()
def fuse_blocks(batch, index, columns, count, source, rules, old_start, old_box, out):
    """Fuse one view's points, grouped by block; returns (observations, segments, agreements).

    New observations are appended block by block, so each (block, view) is one contiguous segment
    with a tight bounding box (``out.box``). Observations of earlier rounds are never changed: what
    agrees with one is logged as (row, confidence). ``columns`` hold ``count`` observations so far;
    of the segments of before, with first observations ``old_start`` and boxes ``old_box``,
    ``out.report[FIRST_SEGMENT]`` is the first that changes.
    """
    starts, order, locals_ = batch.starts, batch.order, batch.locals
    positions, colors, confidence = batch.positions, batch.colors, batch.confidence
    pool_head, block_log2, block_offset = index.pool_head, index.block_log2, index.block_offset
    report, generated = out.report, source.generated
    r_position = columns.positions
    largest = 0
    for g in range(len(batch.touched)):
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
    segments = 0
    agreed = 0
    merged_into = 0
    for g in range(len(batch.touched)):
        block = batch.touched[g]
        level = np.int64(batch.levels[order[starts[g]]])
        inverse = rules.inverse_edge / (1 << level)
        n = 0
        for o in range(starts[g], starts[g + 1]):
            i = order[o]
            log2 = block_log2[block]
            slot = insert_voxel(index, block, locals_[i])
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
            t_spacing[t] += w * batch.spacing[i]
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
            if generated and _observed_there(head, at, level, rules, index, columns):
                pool_head[slot] = head
                report[REJECTED_OBSERVED] += t_points[t]
                continue
            best, cosine, length = _most_similar(head, p, width, source, columns)
            if best != NO_RECORD and (
                length >= rules.capacity
                or (
                    cosine >= rules.cosine_same
                    and width >= rules.min_detail_ratio * columns.spacing[best]
                )
            ):
                pool_head[slot] = head
                report[MERGED_POINTS] += t_points[t]
                if columns.round[best] == source.round:
                    for k in range(3):
                        at[k] = r_position[best, k]
                    _merge(best, p, t_sum[t], weight, own, width, source.row, inverse, columns,
                           rules.weight_cap)  # fmt: skip
                    for k in range(3):
                        moved[k] = r_position[best, k]
                    if generated and _observed_there(head, moved, level, rules, index, columns):
                        for k in range(3):
                            r_position[best, k] = at[k]
                    # Neighbours mostly merge into the same segment.
                    if old_start[merged_into] > best or (
                        merged_into + 1 < len(old_start) and old_start[merged_into + 1] <= best
                    ):
                        merged_into = int(np.searchsorted(old_start, best, side="right")) - 1
                    _include(old_box[merged_into], r_position[best], columns.spacing[best])
                    report[FIRST_SEGMENT] = min(report[FIRST_SEGMENT], merged_into)
                else:
                    report[AGREED] += 1
                    out.agreed_row[agreed] = best
                    out.agreed_weight[agreed] = own
                    agreed += 1
                continue
            for k in range(3):
                r_position[count, k] = at[k]
                columns.colors[count, k] = np.uint8(t_sum[t, 3 + k] / weight + 0.5)
            columns.confidence[count] = min(own, rules.weight_cap)
            columns.spacing[count] = width
            columns.round[count] = source.round
            columns.view_row[count] = source.row
            columns.generated[count] = generated
            columns.level[count] = level
            columns.next[count] = head
            pool_head[slot] = count
            # A voxel whose points all went elsewhere stays empty.
            report[NEW_VOXELS] += head == NO_RECORD
            report[MERGED_POINTS] += t_points[t] - 1
            count += 1
        if count > first:
            out.group[segments] = g
            out.start[segments] = first
            out.length[segments] = count - first
            _box(out.box[segments], r_position[first:count], columns.spacing[first:count])
            segments += 1
            report[ADDED] += count - first
    return count, segments, agreed


@compiled()
def _box(box, positions, spacing):
    """Bounding box and largest spacing of a segment's points (n >= 1)."""
    for k in range(3):
        box[k] = box[3 + k] = positions[0, k]
    box[6] = spacing[0]
    for i in range(1, len(positions)):
        _include(box, positions[i], spacing[i])


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
def _any_observed(head, columns):
    m = head
    while m != NO_RECORD:
        if not columns.generated[m]:
            return True
        m = columns.next[m]
    return False


@compiled()
def _head_at(p, level, inverse_edge, index):
    """The head of the chain of a level's voxel around a point; ``inverse_edge`` of level 0."""
    key, local = voxel_key(p, inverse_edge / (1 << level), level)
    if key == EMPTY_KEY:
        return NO_RECORD
    block = find_block(index.keys, index.ids, key)
    if block < 0:
        return NO_RECORD
    offset, log2 = index.block_offset[block], np.int64(index.block_log2[block])
    slot = find_voxel(index.pool_local, offset, log2, local)
    return index.pool_head[slot] if slot >= 0 else NO_RECORD


@compiled()
def _observed_there(head, p, level, rules, index, columns):
    """Whether a voxel of any level around a point holds observed content; ``head`` is its own."""
    if _any_observed(head, columns):
        return True
    for other in range(rules.top + 1):
        if other != level and _any_observed(_head_at(p, other, rules.inverse_edge, index), columns):
            return True
    return False


@compiled()
def _merge(m, p, sums, weight, own, width, view, inverse_edge, columns, weight_cap):
    """Confidence-weighted running mean; the integer view goes to the more confident side.

    What is merged into is of the same round: no later round has added to its confidence.
    """
    old = np.float64(columns.confidence[m])
    share = own / (old + own)
    for k in range(3):
        value = columns.positions[m, k]
        columns.positions[m, k] = _inside(value + share * (p[k] - value), value, inverse_edge)
        color = columns.colors[m, k] + share * (sums[3 + k] / weight - columns.colors[m, k])
        columns.colors[m, k] = np.uint8(color + 0.5)
    columns.spacing[m] += share * (width - columns.spacing[m])
    if own > old:
        columns.view_row[m] = view
    columns.confidence[m] = min(old + own, weight_cap)


@compiled(inline="always")
def _include(box, point, spacing):
    """Widen a segment's box to a point and its spacing."""
    for k in range(3):
        box[k] = min(box[k], point[k])
        box[3 + k] = max(box[3 + k], point[k])
    box[6] = max(box[6], spacing)


@dataclass(frozen=True)
class FuseReport:
    """What became of the points of one ``fuse``: added, merged or rejected."""

    points: int = 0  # points that arrived
    added: int = 0  # new observations stored
    merged: int = 0  # points averaged into an observation (of this or an earlier view)
    rejected_observed: int = 0  # generated points in voxels that hold observed content
    rejected_free: int = 0  # generated points in space that an observed ray saw to be free
    # Points farther from the origin than voxel keys go, and points without a finite position or a
    # positive, finite confidence and spacing.
    out_of_reach: int = 0
    voxels: int = 0  # voxels that were empty before
    agreed: int = 0  # observations of earlier rounds whose confidence rose
    dropped: dict[str, int] = field(default_factory=dict)  # pixels that gave no point, by reason

    @property
    def rejected(self) -> int:
        """Points that were not taken, for whatever reason."""
        return self.rejected_observed + self.rejected_free + self.out_of_reach

    def __add__(self, other: FuseReport) -> FuseReport:
        dropped = Counter(self.dropped) + Counter(other.dropped)
        names = (f.name for f in fields(self) if f.name != "dropped")
        numbers = {name: getattr(self, name) + getattr(other, name) for name in names}
        return FuseReport(**numbers, dropped=dict(dropped))


class _Outcome(NamedTuple):
    """Points fused into one tile."""

    report: FuseReport
    # Of each new segment's block the first of the points.
    first_point: NDArray[np.int64]
    # The first segment of before whose box may have grown.
    first_changed: int


def fuse(
    store: Store, points: PointSet, *, round: int, generated: bool = False, scanned: bool = False
) -> FuseReport:
    """Take one view's points in; see SpatialMemory.fuse."""
    if not points.frame.same_as(store.frame):
        raise ShapeError(
            f"points are relative to {points.frame.origin}, the memory to {store.origin}, or "
            "their axes differ; back-project with the memory's frame"
        )
    least = store.rounds[-1] if store.rounds else 0
    if not least <= round <= LAST_ROUND:
        raise OptionError(
            f"round {round}; expected {least} to {LAST_ROUND}, as rounds only go forward"
        )
    arrived = len(points)
    keep = np.isfinite(points.positions).all(axis=1)
    keep &= (points.confidence > 0) & np.isfinite(points.confidence)
    keep &= (points.spacing > 0) & np.isfinite(points.spacing)
    unusable = arrived - int(keep.sum())
    free = 0
    if generated and arrived:
        tolerance = store.options.free_space_tolerance
        hit = in_free_space(points.positions, store.observed_grids(), tolerance=tolerance)
        free = int((hit & keep).sum())
        keep &= ~hit
    columns: list[NDArray[Any]] = [
        points.positions, points.colors, points.confidence, points.spacing,
    ]  # fmt: skip
    if not keep.all():
        columns = [column[keep] for column in columns]
    grid = points.free_depth if points.free_depth is not None else np.zeros((0, 0), np.float32)
    store.changes += 1
    store.observed_changes += not generated
    view = store.views.row_for(
        SourceView(points.camera, int(round), bool(generated), grid, bool(scanned))
    )
    if store.in_ram:
        report = _fuse(store, store.whole, columns, view=view).report
    else:
        report = _fuse_tiles(store, columns, view)
    store.page_if_large()
    unusable += report.out_of_reach
    return replace(report, points=arrived, rejected_free=free, out_of_reach=unusable)


def _fuse_tiles(store: Store, columns: list[NDArray[Any]], view: int) -> FuseReport:
    """Fuse points tile by tile; new segments enter the table in the order without tiles."""
    tiles, table = store.tiles, store.segments
    columns = [np.ascontiguousarray(column) for column in columns]
    total, new = FuseReport(), []
    with tiles.lock:
        touched = tiles.of_points(columns[0], columns[3], store.levels)
        for number, points in touched:
            part = tiles.load(number)
            before = part.segments.count
            fused = _fuse(store, part, [c.take(points, axis=0) for c in columns], view=view)
            total += fused.report
            # New points may widen the boxes of older segments.
            grown = slice(fused.first_changed, before)
            rows, boxes = tiles[number].segments[grown], part.segments.box[grown]
            differs = (table.box[rows] != boxes).any(axis=1)
            table.widen(rows[differs], boxes[differs])
            of_part = part.segments.rows()
            start, length, box = (of_part[k][before:].copy() for k in ("start", "length", "box"))
            count = len(start)
            new.append((
                points[fused.first_point], np.full(count, number, np.int32),
                np.arange(before, before + count, dtype=np.int32), start,
                part.columns.level[start], length, box,
            ))  # fmt: skip
            tiles.changed(number)
        if new:
            order = np.argsort(np.concatenate([part[0] for part in new]), kind="stable")
            row = np.empty(len(order), np.int32)
            row[order] = np.arange(table.count, table.count + len(order))
            _, tile, local, first, level, length, box = (
                np.concatenate(column)[order] for column in zip(*new, strict=True)
            )
            ends = np.cumsum([len(part[0]) for part in new])
            for (at, _), rows in zip(touched, np.split(row, ends[:-1]), strict=True):
                tiles[at].segments = np.concatenate([tiles[at].segments, rows])
            table.follow(length, np.full(len(order), view, np.int32), box)
            tiles.places.append_rows(tile, local, first, level)
        tiles.divide_large([number for number, _ in touched])
        tiles.shrink()
    return total


def _fuse(store: Store, part: Observations, columns: list[NDArray[Any]], *, view: int) -> _Outcome:
    """Fuse points (positions, colours, confidence, spacing) that were checked into one tile."""
    positions, colors, confidence, spacing = (np.ascontiguousarray(c) for c in columns)
    count = len(positions)
    keys = np.empty(count, np.int64)
    locals_ = np.empty(count, np.uint16)
    levels = store.levels.of(spacing)
    outside = voxel_keys(positions, levels, 1.0 / store.voxel, keys, locals_)
    if outside:
        near = keys != EMPTY_KEY
        inside = [column[near] for column in (positions, colors, confidence, spacing)]
        fused = _fuse(store, part, inside, view=view)
        report = replace(fused.report, out_of_reach=int(outside))
        return _Outcome(report, np.flatnonzero(near)[fused.first_point], fused.first_changed)
    if not count:
        return _Outcome(FuseReport(), np.empty(0, np.int64), part.segments.count)
    index, views, segments, options = part.index, store.views, part.segments, store.options
    blocks = index.block_numbers(keys)
    touched, starts, order = group_by_block(blocks, index.blocks)
    index.reserve_voxels(count, touched)
    index.top = max(index.top, int(levels.max()))
    part.columns.reserve(count)
    out = FusionOutput(
        group=np.empty(len(touched), np.int32),
        start=np.empty(len(touched), np.int64),
        length=np.empty(len(touched), np.int32),
        box=np.empty((len(touched), 7), np.float32),
        agreed_row=np.empty(count, np.int32),
        agreed_weight=np.empty(count, np.float32),
        report=np.zeros(REPORT_SIZE, np.int64),
    )
    out.report[FIRST_SEGMENT] = segments.count
    batch = Batch(positions, colors, confidence, spacing, levels, locals_, touched, starts, order)
    round_ = int(views.round[view])
    source = FusedView(
        view, round_, bool(views.generated[view]), views.centers[view], views.centers,
        views.scanned,
    )  # fmt: skip
    old = segments.rows()
    rules = FusionRules(
        cosine_same=float(np.cos(np.radians(options.merge_angle_deg))),
        min_detail_ratio=options.min_detail_ratio,
        capacity=options.observations_per_voxel,
        weight_cap=options.weight_cap,
        inverse_edge=1.0 / store.voxel,
        top=index.top,
    )
    part.columns.count, added, agreed = fuse_blocks(
        batch, index.arrays, part.columns.arrays, len(part), source, rules, old["start"],
        old["box"], out,
    )  # fmt: skip
    index.voxels += int(out.report[NEW_VOXELS])
    segments.append(
        out.start[:added], out.length[:added], np.full(added, view, np.int32), box=out.box[:added],
        changed=int(out.report[FIRST_SEGMENT]),
    )  # fmt: skip
    if agreed:
        rows, weights = out.agreed_row[:agreed].copy(), out.agreed_weight[:agreed].copy()
        part.agree(rows, weights, round=round_)
    report = FuseReport(
        added=int(out.report[ADDED]),
        merged=int(out.report[MERGED_POINTS]),
        rejected_observed=int(out.report[REJECTED_OBSERVED]),
        voxels=int(out.report[NEW_VOXELS]),
        agreed=int(out.report[AGREED]),
    )
    changed = int(out.report[FIRST_SEGMENT])
    return _Outcome(report, order[starts[out.group[:added]]], changed)
