"""Fusion of one view's points into a memory, and its report."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ShapeError
from gvtools.memory import fusion_kernels as kernels
from gvtools.memory.occlusion import in_free_space
from gvtools.memory.store.columns import LAST_ROUND
from gvtools.memory.store.observations import Observations
from gvtools.memory.store.store import Store
from gvtools.memory.store.views import PointSet, SourceView
from gvtools.memory.store.voxel_index import EMPTY_KEY, group_by_block, voxel_keys


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


class _Fused(NamedTuple):
    """What became of points in one tile."""

    report: FuseReport
    # Of each new segment's block the first of the points.
    first_point: NDArray[np.int64]
    # The first segment of before whose box may have grown.
    first_changed: int


def fuse(
    store: Store, points: PointSet, *, round: int, generated: bool = False, scanned: bool = False
) -> FuseReport:
    """Take one view's points in; see SpatialMemory.fuse."""
    _check(store, points, round)
    arrived = len(points)
    keep = np.isfinite(points.positions).all(axis=1)
    keep &= (points.confidence > 0) & np.isfinite(points.confidence)
    keep &= (points.spacing > 0) & np.isfinite(points.spacing)
    unusable = arrived - int(keep.sum())
    free = 0
    if generated and arrived:
        hit = in_free_space(
            points.positions,
            store.observed_grids(range(len(store.views))),
            tolerance=store.options.free_space_tolerance,
        )
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


def _check(store: Store, points: PointSet, round: int) -> None:
    if not points.frame.same_as(store.frame):
        raise ShapeError(
            f"points are relative to {points.frame.origin}, the memory to {store.origin}, or "
            "their axes differ; back-project with the memory's frame"
        )
    if store.rounds and round < store.rounds[-1]:
        raise OptionError(
            f"fusing into round {round} after round {store.rounds[-1]}; rounds only go forward"
        )
    if not 0 <= round <= LAST_ROUND:
        raise OptionError(f"round {round}; expected 0 to {LAST_ROUND}")


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
            tiles.places.append(tile, local, first, level=level)
        tiles.divide_large([number for number, _ in touched])
        tiles.shrink()
    return total


def _fuse(store: Store, part: Observations, columns: list[NDArray[Any]], *, view: int) -> _Fused:
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
        return _Fused(report, np.flatnonzero(near)[fused.first_point], fused.first_changed)
    if not count:
        return _Fused(FuseReport(), np.empty(0, np.int64), part.segments.count)
    index, views, segments, options = part.index, store.views, part.segments, store.options
    blocks = index.block_numbers(keys)
    touched, starts, order = group_by_block(blocks, index.blocks)
    index.reserve_voxels(count, touched)
    index.top = max(index.top, int(levels.max()))
    part.columns.reserve(count)
    out = kernels.FusionOutput(
        group=np.empty(len(touched), np.int32),
        start=np.empty(len(touched), np.int64),
        length=np.empty(len(touched), np.int32),
        box=np.empty((len(touched), 7), np.float32),
        agreed_row=np.empty(count, np.int32),
        agreed_weight=np.empty(count, np.float32),
        report=np.zeros(kernels.REPORT_SIZE, np.int64),
    )
    out.report[kernels.FIRST_SEGMENT] = segments.count
    batch = kernels.Batch(
        positions, colors, confidence, spacing, levels, locals_, touched, starts, order
    )
    round_ = int(views.round[view])
    source = kernels.FusedView(
        view, round_, bool(views.generated[view]), views.centers[view], views.centers,
        views.scanned,
    )  # fmt: skip
    old = kernels.SegmentTable(segments.start[: segments.count], segments.box[: segments.count])
    rules = kernels.FusionRules(
        cosine_same=float(np.cos(np.radians(options.merge_angle_deg))),
        min_detail_ratio=options.min_detail_ratio,
        capacity=options.observations_per_voxel,
        weight_cap=options.weight_cap,
        inverse_edge=1.0 / store.voxel,
        top=index.top,
    )
    part.columns.count, added, agreed = kernels.fuse_blocks(
        batch, index.arrays, part.columns.arrays, len(part), source, rules, old, out
    )
    index.voxels += int(out.report[kernels.NEW_VOXELS])
    segments.append(
        out.start[:added], out.length[:added], np.full(added, view, np.int32), box=out.box[:added],
        changed=int(out.report[kernels.FIRST_SEGMENT]),
    )  # fmt: skip
    if agreed:
        rows, weights = out.agreed_row[:agreed].copy(), out.agreed_weight[:agreed].copy()
        part.agree(rows, weights, round=round_)
    report = FuseReport(
        added=int(out.report[kernels.ADDED]),
        merged=int(out.report[kernels.MERGED_POINTS]),
        rejected_observed=int(out.report[kernels.REJECTED_OBSERVED]),
        voxels=int(out.report[kernels.NEW_VOXELS]),
        agreed=int(out.report[kernels.AGREED]),
    )
    changed = int(out.report[kernels.FIRST_SEGMENT])
    return _Fused(report, order[starts[out.group[:added]]], changed)
