"""The persistent memory: coloured observations in voxels, fused view by view, undone by round."""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError, ShapeError
from gvtools.memory import fusion
from gvtools.memory.occlusion import FreeGrid, in_free_space
from gvtools.memory.store.columns import Records, Runs
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.points import PointSet
from gvtools.memory.store.views import SourceView, ViewTable
from gvtools.memory.store.voxel_index import EMPTY_KEY, MAX_VOXEL, VoxelIndex, check_grid
from gvtools.memory.store.voxel_levels import VoxelLevels
from gvtools.options import check_range

if TYPE_CHECKING:
    import open3d as o3d

    from gvtools.guidance import Guidance
    from gvtools.memory.splat.api import SplatOptions


@dataclass(frozen=True, kw_only=True)
class MemoryOptions:
    """How observations are kept.

    Attributes:
        same_direction: degrees; observations of one voxel seen from directions closer than this
            merge when the new one is no finer.
        finer: a new observation whose spacing is below this share of the old one's stands on its
            own, so that a close-up is not averaged into a distant view.
        observations_per_voxel: longest chain; beyond it the most similar observation takes the
            new one in.
        weight_cap: confidence saturates here, 1e-20 to 1e20; so it does where what a view adds is
            below 2⁻²⁴ of what is there.
        footprints: an observation goes into a voxel at most so many times as wide as its spacing
            where that is wider than the memory's edge: twice, four times, ... to 128 times that
            edge. 0 has one edge throughout.
        free_space_tolerance: share of depth that a generated point may stand in front of an
            observed surface.
    """

    same_direction: float = 2.0
    finer: float = 0.7
    observations_per_voxel: int = 12
    weight_cap: float = 100.0
    footprints: float = 1.0
    free_space_tolerance: float = 0.03

    def __post_init__(self) -> None:
        check_range("memory.same_direction", self.same_direction, least=0, most=180)
        check_range("memory.finer", self.finer, least=0, most=1)
        check_range("memory.observations_per_voxel", self.observations_per_voxel, least=1)
        check_range("memory.weight_cap", self.weight_cap, least=1e-20, most=1e20)
        check_range("memory.footprints", self.footprints, least=0)
        check_range("memory.free_space_tolerance", self.free_space_tolerance, least=0, below=1)


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
    """

    points: int = 0
    added: int = 0
    merged: int = 0
    rejected_observed: int = 0
    rejected_free: int = 0
    out_of_reach: int = 0
    voxels: int = 0
    agreed: int = 0

    @property
    def rejected(self) -> int:
        """Points that were not taken, for whatever reason."""
        return self.rejected_observed + self.rejected_free + self.out_of_reach

    def __add__(self, other: FuseReport) -> FuseReport:
        return FuseReport(**{k: v + getattr(other, k) for k, v in asdict(self).items()})


class SpatialMemory:
    """A coloured point cloud that grows view by view.

    Space is divided into voxels, wider ones (``MemoryOptions.footprints``) where it was seen
    coarsely; a voxel keeps several observations, each of which remembers the view it came from.
    Observations are appended and, once their round is over, never changed, so that a round can be
    forgotten exactly.

    Args:
        voxel: edge of the finest voxels, scene units.
        origin: (3,) float64 world point that positions are held relative to, so that float32
            keeps millimetres in a georeferenced scene.
        axes: (3, 3) rotation whose columns are the voxel grid's axes in the world frame; None for
            the world's own. See LocalFrame.
        options: see MemoryOptions.
    """

    def __init__(
        self,
        voxel: float,
        *,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        axes: ArrayLike | None = None,
        options: MemoryOptions | None = None,
    ) -> None:
        self.voxel = float(voxel)
        self.frame = LocalFrame.at(origin, axes)
        check_grid(self.voxel, self.origin)
        self.options = options or MemoryOptions()
        self.records = Records()
        self.runs = Runs()
        self.views = ViewTable(self.frame)
        self.levels = VoxelLevels(self.voxel, self.options.footprints)
        # Per round: (records, confidences) by which it agreed with observations of other rounds.
        self.agreements: dict[int, list[tuple[NDArray[np.int32], NDArray[np.float32]]]] = {}
        # How often something was fused or forgotten, and how often that touched observations.
        self.changes = self.observed_changes = 0
        self._index = VoxelIndex()
        # The highest level of any voxel.
        self._top = 0

    @property
    def origin(self) -> NDArray[np.float64]:
        """(3,) world point that positions are held relative to."""
        return self.frame.origin

    def __len__(self) -> int:
        """Number of stored observations."""
        return self.records.count

    def __repr__(self) -> str:
        generated = int(self.generated.sum())
        return (
            f"SpatialMemory({len(self):,} observations ({generated:,} generated) in "
            f"{self.voxels:,} voxels of {self.voxel:g}, {len(self.views)} views, "
            f"rounds {self.rounds!r}, {self.nbytes / 2**20:.1f} MiB)"
        )

    @property
    def voxels(self) -> int:
        """Number of occupied voxels."""
        return self._index.voxels

    @property
    def reach(self) -> float:
        """How far from the origin, along each axis, the finest voxels go, scene units."""
        return MAX_VOXEL * self.voxel

    @property
    def rounds(self) -> tuple[int, ...]:
        """The rounds that views were fused in, in order."""
        return tuple(sorted(set(self.views.round.tolist())))

    @property
    def nbytes(self) -> int:
        """Bytes of everything that is kept, without spare capacity."""
        grids = sum(self.views[i].free_depth.nbytes for i in range(len(self.views)))
        agreed = sum(r.nbytes + w.nbytes for log in self.agreements.values() for r, w in log)
        return self.records.nbytes + self.runs.nbytes + self._index.nbytes + grids + agreed

    @property
    def positions(self) -> NDArray[np.float64]:
        """(N, 3) float64, world frame, scene units."""
        return self.frame.to_world(self.records.position)

    @property
    def confidence(self) -> NDArray[np.float32]:
        """(N,) float32: own confidence and what later rounds added, capped."""
        n = len(self)
        total = self.records.confidence[:n] + self.records.agreement[:n]
        return np.minimum(total, np.float32(self.options.weight_cap))

    @property
    def generated(self) -> NDArray[np.bool_]:
        """(N,) bool."""
        return self.views.generated[self.records.view[: len(self)]]

    def fuse(self, points: PointSet, *, round: int, generated: bool = False) -> FuseReport:
        """Take one view's points in.

        Args:
            points: in this memory's frame.
            round: the round they belong to; not smaller than any round already there.
            generated: True for a completer's points: they enter neither voxels that hold observed
                content nor space that an observed ray saw to be free.

        Raises:
            OptionError: ``round`` lies before the last one.
            ShapeError: the points are in another frame.
        """
        if not points.frame.same_as(self.frame):
            raise ShapeError(
                f"points are relative to {points.frame.origin}, the memory to {self.origin}, or "
                "their axes differ; back-project with the memory's frame"
            )
        if self.rounds and round < self.rounds[-1]:
            raise OptionError(
                f"fusing into round {round} after round {self.rounds[-1]}; rounds only go forward"
            )
        arrived = len(points)
        keep = np.isfinite(points.positions).all(axis=1)
        keep &= (points.confidence > 0) & np.isfinite(points.confidence)
        keep &= (points.spacing > 0) & np.isfinite(points.spacing)
        unusable = arrived - int(keep.sum())
        free = 0
        if generated and arrived:
            hit = in_free_space(
                points.positions,
                self.observed_grids(range(len(self.views))),
                tolerance=self.options.free_space_tolerance,
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
        self.changes += 1
        self.observed_changes += not generated
        view = self.views.take(SourceView(points.camera, int(round), bool(generated), grid))
        report = self._fuse_columns(columns, view)
        return replace(
            report,
            points=arrived,
            rejected_free=free,
            out_of_reach=report.out_of_reach + unusable,
        )

    def observed_grids(self, rows: Iterable[int]) -> list[FreeGrid]:
        """K, cam_from_local and free-space grid of the observed views among ``rows``."""
        views = self.views
        return [
            (views[i].camera.K[0], views.cam_from_local[i], views[i].free_depth)
            for i in rows
            if not views.generated[i]
        ]

    def _fuse_columns(self, columns: list[NDArray[Any]], view: int) -> FuseReport:
        positions, colors, confidence, spacing = (np.ascontiguousarray(c) for c in columns)
        count = len(positions)
        keys = np.empty(count, np.int64)
        locals_ = np.empty(count, np.uint16)
        levels = self.levels.of(spacing)
        outside = fusion.voxel_keys(positions, levels, 1.0 / self.voxel, keys, locals_)
        if outside:
            near = keys != EMPTY_KEY
            inside = [column[near] for column in (positions, colors, confidence, spacing)]
            report = self._fuse_columns(inside, view)
            return replace(report, out_of_reach=int(outside))
        if not count:
            return FuseReport()
        index, records, views, options = self._index, self.records, self.views, self.options
        blocks = index.block_numbers(keys)
        touched, starts, order = fusion.group_by_block(blocks, index.blocks)
        index.reserve_voxels(count, touched)
        records.reserve(count)
        self._top = max(self._top, int(levels.max()))
        first = records.count
        run_start = np.empty(len(touched), np.int64)
        run_length = np.empty(len(touched), np.int32)
        run_box = np.empty((len(touched), 7), np.float32)
        agreed_record = np.empty(count, np.int32)
        agreed_weight = np.empty(count, np.float32)
        tally = np.zeros(fusion.REPORT_SIZE, np.int64)
        tally[fusion.FIRST_RUN] = self.runs.count
        records.count, runs, agreed = fusion.fuse_blocks(
            positions, colors, confidence, spacing, levels, locals_, touched, starts, order,
            index.keys, index.ids, index.pool_local, index.pool_head, index.pool_state,
            index.block_offset, index.block_log2, index.block_count, self._top,
            records.x, records.y, records.z, records.color, records.confidence, records.spacing,
            records.view, records.level, records.next, first,
            view, views.centers[view], views.centers, views.round, views.generated,
            np.cos(np.radians(options.same_direction)), options.finer,
            options.observations_per_voxel, options.weight_cap, 1.0 / self.voxel,
            self.runs.start[: self.runs.count], self.runs.box[: self.runs.count],
            run_start, run_length, run_box, agreed_record, agreed_weight, tally,
        )  # fmt: skip
        index.voxels += int(tally[fusion.NEW_VOXELS])
        records.agreement[first : records.count] = 0
        self.runs.append(
            run_start[:runs], run_length[:runs], np.full(runs, view, np.int32), run_box[:runs],
            changed=int(tally[fusion.FIRST_RUN]),
        )  # fmt: skip
        if agreed:
            entry = (agreed_record[:agreed].copy(), agreed_weight[:agreed].copy())
            self.agreements.setdefault(int(views.round[view]), []).append(entry)
            records.agree(*entry)
        return FuseReport(
            added=int(tally[fusion.ADDED]),
            merged=int(tally[fusion.MERGED_POINTS]),
            rejected_observed=int(tally[fusion.REJECTED_OBSERVED]),
            voxels=int(tally[fusion.NEW_VOXELS]),
            agreed=int(tally[fusion.AGREED]),
        )

    def forget(self, *, round: int) -> int:
        """Undo a round: its views, its observations and the confidence it added elsewhere.

        After the last round is forgotten, the memory is bit for bit what it was before it. When an
        earlier round is forgotten, later ones keep what they stored.

        Returns:
            How many observations were removed.

        Raises:
            OptionError: no view was fused in that round.
        """
        if round not in self.rounds:
            raise OptionError(f"round {round} is not in the memory; it has rounds {self.rounds}")
        self.changes += 1
        self.observed_changes += 1
        records, views = self.records, self.views
        count = records.count
        keep_view = views.round != round
        new_view = np.cumsum(keep_view) - 1
        keep = keep_view[records.view[:count]]
        new_record = np.cumsum(keep) - 1
        for name in records.ARRAYS:
            array = getattr(records, name)
            setattr(records, name, array[:count][keep])
        records.count = int(keep.sum())
        records.view[:] = new_view[records.view]
        self.views = ViewTable(self.frame, [views[int(i)] for i in np.flatnonzero(keep_view)])
        self.agreements.pop(round, None)
        records.agreement[:] = 0
        for log in self.agreements.values():
            for i, (row, weight) in enumerate(log):
                stays = keep[row]
                log[i] = (new_record[row[stays]].astype(np.int32), weight[stays])
                records.agree(*log[i])
        # A run holds one view's observations, so it stays or goes as a whole.
        runs, n = self.runs, self.runs.count
        stays = keep_view[runs.view[:n]]
        start = new_record[runs.start[:n][stays]]
        self.runs = Runs()
        self.runs.append(
            start, runs.length[:n][stays],
            new_view[runs.view[:n][stays]].astype(np.int32), runs.box[:n][stays],
        )  # fmt: skip
        self.rebuild_index()
        return count - records.count

    def rebuild_index(self) -> None:
        """Make the voxel index anew from the observations (after loading or forgetting)."""
        self._index = VoxelIndex()
        records, count = self.records, self.records.count
        keys = np.empty(count, np.int64)
        locals_ = np.empty(count, np.uint16)
        levels = records.level[:count]
        self._top = int(levels.max(initial=0))
        if fusion.voxel_keys(records.position, levels, 1.0 / self.voxel, keys, locals_):
            raise OptionError(f"observations lie beyond the reach of voxels of {self.voxel:g}")
        blocks = self._index.block_numbers(keys)
        self._index.reserve_voxels(count, np.unique(blocks))
        index = self._index
        fusion.link_records(
            locals_, index.pool_local, index.pool_head, index.pool_state,
            index.block_offset, index.block_log2, index.block_count, blocks, records.next,
        )  # fmt: skip
        index.voxels = int(index.block_count[: index.blocks].sum())

    def project(self, cameras: Cameras, *, options: SplatOptions | None = None) -> Guidance:
        """Project the memory into cameras of one size; see gvtools.memory.projection.project."""
        from gvtools.memory.projection import project

        return project(self, cameras, options=options)

    def snapshot(self) -> SpatialMemory:
        """This memory as it is now, for looking at what was observed beside later fusions.

        The arrays are shared, so generated observations may still change in it. Neither of the two
        must be fused into or forgotten from but for generated content in the original.
        """
        other = copy(self)
        other.records, other.runs = copy(self.records), copy(self.runs)
        other.views = ViewTable(self.frame, [self.views[i] for i in range(len(self.views))])
        return other

    def point_cloud(self) -> o3d.t.geometry.PointCloud:
        """The observations as an Open3D tensor point cloud.

        Positions are float32 relative to ``origin`` when the origin is not zero (add it back in
        float64), colours uint8; attributes (N, 1): confidence, spacing (float32), round, view
        (int32), generated (uint8).
        """
        import open3d as o3d

        n = len(self)
        records, views = self.records, self.views
        cloud = o3d.t.geometry.PointCloud()
        tensor = o3d.core.Tensor.from_numpy
        view = records.view[:n]
        positions = records.position
        if not np.array_equal(self.frame.axes, np.eye(3)):
            positions = (positions.astype(np.float64) @ self.frame.axes.T).astype(np.float32)
        cloud.point.positions = tensor(positions)
        cloud.point.colors = tensor(records.color[:n].copy())
        cloud.point.confidence = tensor(self.confidence[:, None])
        cloud.point.spacing = tensor(records.spacing[:n, None].copy())
        cloud.point.round = tensor(views.round[view][:, None])
        cloud.point.view = tensor(view[:, None].copy())
        cloud.point.generated = tensor(self.generated.astype(np.uint8)[:, None])
        return cloud

    def save(self, path: Path | str) -> None:
        """Write the memory; see gvtools.memory.io.npz."""
        from gvtools.memory.io.npz import save_memory

        save_memory(self, Path(path))

    @staticmethod
    def load(path: Path | str) -> SpatialMemory:
        """Read a memory; see gvtools.memory.io.npz."""
        from gvtools.memory.io.npz import load_memory

        return load_memory(Path(path))
