"""Fusion of one view's points into a store, and the report of what became of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ShapeError
from gvtools.memory import fusion_kernels as kernels
from gvtools.memory.occlusion import in_free_space
from gvtools.memory.store.columns import LAST_ROUND
from gvtools.memory.store.points import PointSet
from gvtools.memory.store.store import Store
from gvtools.memory.store.views import SourceView
from gvtools.memory.store.voxel_index import EMPTY_KEY, group_by_block, voxel_keys


@dataclass(frozen=True)
class FuseReport:
    """What became of the points of one ``fuse``.

    ``added``, ``merged`` and ``rejected`` add up to ``points``.

    Attributes:
        points: points that arrived.
        added: new observations stored.
        merged: points averaged into an observation (of this or an earlier view).
        rejected_observed: generated points in voxels that hold observed content.
        rejected_free: generated points in space that an observed ray saw to be free.
        out_of_reach: points farther from the origin than voxel keys go, and points without a finite
            position or a positive, finite confidence and spacing.
        voxels: voxels that were empty before.
        agreed: observations of earlier rounds whose confidence rose.
        dropped: pixels that gave no point, by reason.
    """

    points: int = 0
    added: int = 0
    merged: int = 0
    rejected_observed: int = 0
    rejected_free: int = 0
    out_of_reach: int = 0
    voxels: int = 0
    agreed: int = 0
    dropped: dict[str, int] = field(default_factory=dict)

    @property
    def rejected(self) -> int:
        """Points that were not taken, for whatever reason."""
        return self.rejected_observed + self.rejected_free + self.out_of_reach

    def __add__(self, other: FuseReport) -> FuseReport:
        dropped = Counter(self.dropped) + Counter(other.dropped)
        names = (f.name for f in fields(self) if f.name != "dropped")
        numbers = {name: getattr(self, name) + getattr(other, name) for name in names}
        return FuseReport(**numbers, dropped=dict(dropped))


@dataclass(frozen=True, eq=False)
class Fused:
    """What became of points in one store.

    Attributes:
        report: see FuseReport.
        first_point: (S,) int64, of each new segment's block the first of the points.
        first_changed: the first segment of before whose box may have grown.
    """

    report: FuseReport
    first_point: NDArray[np.int64]
    first_changed: int


# Points as columns (positions, colours, confidence, spacing), and the row of their view.
Take = Callable[[list[NDArray[Any]], int], FuseReport]


def fuse(
    store: Store,
    points: PointSet,
    *,
    round: int,
    generated: bool = False,
    scanned: bool = False,
    take: Take | None = None,
) -> FuseReport:
    """Take one view's points in; see SpatialMemory.fuse.

    Args:
        store: that checks the points and knows the views.
        points: see SpatialMemory.fuse.
        round: likewise.
        generated: likewise.
        scanned: likewise.
        take: gets what is left of the points; None fuses it into the store itself.
    """
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
        points.positions,
        points.colors,
        points.confidence,
        points.spacing,
    ]
    if not keep.all():
        columns = [column[keep] for column in columns]
    grid = points.free_depth if points.free_depth is not None else np.zeros((0, 0), np.float32)
    store.changes += 1
    store.observed_changes += not generated
    view = store.views.row_for(
        SourceView(points.camera, int(round), bool(generated), grid, bool(scanned))
    )
    report = take(columns, view) if take else fuse_columns(store, columns, view).report
    return replace(
        report,
        points=arrived,
        rejected_free=free,
        out_of_reach=report.out_of_reach + unusable,
    )


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


def fuse_columns(store: Store, columns: list[NDArray[Any]], view: int) -> Fused:
    """Fuse points that were checked into a store.

    Args:
        store: knows the views.
        columns: positions, colours, confidence and spacing of the points.
        view: row of the view that they come from.
    """
    positions, colors, confidence, spacing = (np.ascontiguousarray(c) for c in columns)
    count = len(positions)
    keys = np.empty(count, np.int64)
    locals_ = np.empty(count, np.uint16)
    levels = store.levels.of(spacing)
    outside = voxel_keys(positions, levels, 1.0 / store.voxel, keys, locals_)
    if outside:
        near = keys != EMPTY_KEY
        inside = [column[near] for column in (positions, colors, confidence, spacing)]
        fused = fuse_columns(store, inside, view)
        report = replace(fused.report, out_of_reach=int(outside))
        return replace(fused, report=report, first_point=np.flatnonzero(near)[fused.first_point])
    if not count:
        return Fused(FuseReport(), np.empty(0, np.int64), store.segments.count)
    index, views, segments = store.index, store.views, store.segments
    blocks = index.block_numbers(keys)
    touched, starts, order = group_by_block(blocks, index.blocks)
    index.reserve_voxels(count, touched)
    index.top = max(index.top, int(levels.max()))
    store.columns.reserve(count)
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
    store.columns.count, added, agreed = kernels.fuse_blocks(
        batch, index.arrays, store.columns.arrays, len(store), source, _rules(store), old, out
    )
    index.voxels += int(out.report[kernels.NEW_VOXELS])
    segments.append(
        out.start[:added], out.length[:added], np.full(added, view, np.int32), box=out.box[:added],
        changed=int(out.report[kernels.FIRST_SEGMENT]),
    )  # fmt: skip
    if agreed:
        rows, weights = out.agreed_row[:agreed].copy(), out.agreed_weight[:agreed].copy()
        store.agree(rows, weights, round=round_)
    report = FuseReport(
        added=int(out.report[kernels.ADDED]),
        merged=int(out.report[kernels.MERGED_POINTS]),
        rejected_observed=int(out.report[kernels.REJECTED_OBSERVED]),
        voxels=int(out.report[kernels.NEW_VOXELS]),
        agreed=int(out.report[kernels.AGREED]),
    )
    changed = int(out.report[kernels.FIRST_SEGMENT])
    return Fused(report, order[starts[out.group[:added]]], changed)


def _rules(store: Store) -> kernels.FusionRules:
    options = store.options
    return kernels.FusionRules(
        cosine_same=float(np.cos(np.radians(options.merge_angle_deg))),
        min_detail_ratio=options.min_detail_ratio,
        capacity=options.observations_per_voxel,
        weight_cap=options.weight_cap,
        inverse_edge=1.0 / store.voxel,
        top=store.index.top,
    )
