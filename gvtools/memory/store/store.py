"""What a memory keeps: observations, their segments, the views and the voxel index."""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy, deepcopy
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator

from gvtools.errors import OptionError
from gvtools.memory.store.byte_sizes import bytes_of
from gvtools.memory.store.columns import Columns, Segments
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.views import FreeGrid, ViewTable
from gvtools.memory.store.voxel_index import (
    MAX_VOXEL,
    VoxelIndex,
    check_grid,
    link_records,
    voxel_keys,
)
from gvtools.memory.store.voxel_levels import VoxelLevels
from gvtools.settings import Settings

if TYPE_CHECKING:
    import open3d as o3d

    from gvtools.memory.tiles.tile_set import TileSet

S = TypeVar("S", bound="Store")


class MemoryOptions(Settings):
    """How observations are kept."""

    section = "memory"

    merge_angle_deg: float = Field(2.0, ge=0, le=180)
    """Two observations of a voxel merge if their viewing directions differ by at most this angle,
    degrees, and ``min_detail_ratio`` allows it."""
    min_detail_ratio: float = Field(0.7, ge=0, le=1)
    """Smallest ratio of new to stored spacing at which they still merge. A finer observation, such
    as a close-up, is stored separately instead of being averaged into a distant view."""
    observations_per_voxel: int = Field(12, ge=1)
    """Most observations that a voxel keeps. In a full voxel a new one merges with the most similar,
    whatever its direction and spacing."""
    weight_cap: float = Field(100.0, ge=1e-20, le=1e20)
    """Upper limit of an observation's confidence. Confidence is float32, so a contribution below
    2⁻²⁴ of the present value has no effect either."""
    voxels_per_footprint: float = Field(1.0, ge=0)
    """Widest voxel that a point may go into, in multiples of its spacing. Voxel edges are 1, 2, 4,
    ... 128 times ``voxel``; a point goes into the widest one within this limit, never into one
    finer than ``voxel``. 0: all voxels have the edge ``voxel``."""
    free_space_tolerance: float = Field(0.03, ge=0, lt=1)
    """Share of depth that a generated point may stand in front of an observed surface."""
    budget: int | None = Field(None, ge=1_000_000)
    """RAM that the memory may take, such as ``4GB``, ``400MB`` or ``2GiB``. A memory that outgrows
    half of it is kept in tiles on disk, of which some are in RAM; none keeps everything in RAM.
    [bytes]"""

    @field_validator("budget", mode="before")
    @classmethod
    def _bytes(cls, value: Any) -> Any:
        return bytes_of(value) if isinstance(value, str) else value


class Store:
    """Observations in voxels, the views they come from, and the confidence that rounds added.

    It grows, forgets and rebuilds its index; it knows nothing of fusion, projection or files.

    Args:
        voxel: edge of the finest voxels, scene units.
        origin: (3,) float64 world point that positions are held relative to, so that float32
            keeps millimetres in a georeferenced scene.
        axes: (3, 3) rotation whose columns are the voxel grid's axes in the world frame; None for
            the world's own. See LocalFrame.
        options: see MemoryOptions.
        device: where the tensors live, "cpu" or "cuda:0". What runs on the CPU (fusing, forgetting,
            the cpu and one-pixel back ends) needs them there, see ``to``; elsewhere the torch back
            end projects them and Open3D uses them.

    Attributes:
        columns: the observations.
        segments: runs of consecutive observations of one view in one block (16 x 16 x 16 voxels).
        views: the fused views: camera, round, whether generated, free-space grid.
        index: which voxel holds which.
        agreements: by round, one entry for each fused view that saw what was there already: (rows
            (A,) of observations of earlier rounds, confidence added (A,), confidence before (A,)).
        changes: how often something was fused or forgotten.
        observed_changes: how often that touched observed content.
        tiles: where the observations of a memory larger than RAM lie, instead of in ``columns``;
            None in RAM.
    """

    tiles: TileSet | None = None

    def __init__(
        self,
        voxel: float,
        *,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        axes: ArrayLike | None = None,
        options: MemoryOptions | None = None,
        device: str = "cpu",
    ) -> None:
        self.voxel = float(voxel)
        self.frame = LocalFrame.at(origin, axes)
        check_grid(self.voxel, self.origin)
        self.options = options or MemoryOptions()
        self.columns = Columns(device)
        self.segments = Segments()
        self.views = ViewTable(self.frame)
        self.levels = VoxelLevels(self.voxel, self.options.voxels_per_footprint)
        self.index = VoxelIndex()
        self.agreements: dict[
            int, list[tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]]
        ] = {}
        self.changes = self.observed_changes = 0

    @property
    def origin(self) -> NDArray[np.float64]:
        """(3,) world point that positions are held relative to."""
        return self.frame.origin

    @property
    def reach(self) -> float:
        """Half the side of the cube around the origin that voxels cover, scene units."""
        return MAX_VOXEL * self.voxel

    @property
    def rounds(self) -> tuple[int, ...]:
        """The rounds that views were fused in, in order."""
        return tuple(sorted(set(self.views.round.tolist())))

    @property
    def voxels(self) -> int:
        """Number of occupied voxels."""
        return self.index.voxels

    @property
    def cloud(self) -> o3d.t.geometry.PointCloud:
        """The observations: a point cloud whose attributes lie in the store's own memory.

        ``positions`` (N, 3) float32 in the memory's frame (``frame.to_world`` gives the world's),
        ``colors`` (N, 3) uint8 and, (N, 1) each, ``confidence`` and ``spacing`` float32, ``round``
        uint16, ``view`` int32, ``generated`` and ``level`` uint8. It has the memory's present
        length: ask again after a fusion. Writing into it changes the memory, but not its voxel
        index, so ``clone()`` it before moving points.
        """
        return self.columns.cloud()

    @property
    def positions(self) -> NDArray[np.float64]:
        """(N, 3) float64, world frame, scene units."""
        return self.frame.to_world(self.columns.positions)

    @property
    def confidence(self) -> NDArray[np.float32]:
        """(N,) float32: own confidence and what later rounds added, capped."""
        return self.columns.confidence

    @property
    def generated(self) -> NDArray[np.bool_]:
        """(N,) bool: True if a completer made the observation, False if a camera observed it."""
        return self.columns.generated.view(np.bool_)

    @property
    def scanned(self) -> NDArray[np.bool_]:
        """(N,) bool: True if a scan brought the observation, see ``ViewTable.scanned``."""
        return self.views.scanned[self.columns.view]

    @property
    def nbytes(self) -> int:
        """Bytes of everything that is kept, without spare capacity."""
        grids = sum(self.views[i].free_depth.nbytes for i in range(len(self.views)))
        return self.stored_bytes + grids

    @property
    def stored_bytes(self) -> int:
        """Bytes of the observations, their segments and index, and what was agreed."""
        agreed = sum(array.nbytes for log in self.agreements.values() for e in log for array in e)
        return self.columns.nbytes + self.segments.nbytes + self.index.nbytes + agreed

    @property
    def generated_count(self) -> int:
        """Number of observations that a completer made."""
        return self._count_of(self.views.generated)

    @property
    def scanned_count(self) -> int:
        """Number of observations that a scan brought."""
        return self._count_of(self.views.scanned)

    def _count_of(self, kind: NDArray[np.bool_]) -> int:
        """Number of observations of the views that are of a kind, (views,)."""
        segments, n = self.segments, self.segments.count
        return int(segments.length[:n][kind[segments.view[:n]]].sum(dtype=np.int64))

    def __len__(self) -> int:
        """Number of stored observations."""
        return self.columns.count

    def __repr__(self) -> str:
        generated, scanned = self.generated_count, self.scanned_count
        apart = f"{generated:,} generated" + (f", {scanned:,} scanned" if scanned else "")
        where = "" if self.columns.device == "cpu" else f" on {self.columns.device}"
        return (
            f"{type(self).__name__}({len(self):,} observations ({apart}) in "
            f"{self.voxels:,} voxels of {self.voxel:g}, {len(self.views)} views, "
            f"rounds {self.rounds!r}, {self.nbytes / 2**20:.1f} MiB{where})"
        )

    def observed_grids(self, rows: Iterable[int]) -> list[FreeGrid]:
        """(K, cam_from_local, free_depth) of those views in ``rows`` that are not generated."""
        views = self.views
        return [
            (views[i].camera.K[0], views.cam_from_local[i], views[i].free_depth)
            for i in rows
            if not views.generated[i]
        ]

    def agree(self, rows: NDArray[np.int32], weights: NDArray[np.float32], *, round: int) -> None:
        """Raise the confidence of ``rows``, each once, up to the cap; ``forget`` can undo it."""
        confidence = self.columns.arrays.confidence
        before = confidence[rows]
        with np.errstate(over="ignore"):
            confidence[rows] = np.minimum(before + weights, np.float32(self.options.weight_cap))
        self.agreements.setdefault(round, []).append((rows, weights, before))

    def own_confidence(self) -> NDArray[np.float32]:
        """(N,) float32, a copy: confidence without what later rounds added."""
        own = self.columns.confidence.copy()
        for round_ in sorted(self.agreements, reverse=True):
            for rows, _, before in reversed(self.agreements[round_]):
                own[rows] = before
        return own

    def forget(self, *, round: int) -> int:
        """Undo a round: its views, its observations and the confidence it added elsewhere.

        After the last round is forgotten, the memory is bit for bit what it was before it. When an
        earlier round is forgotten, later ones keep what they stored.

        Returns:
            How many observations were removed.
        """
        if round not in self.rounds:
            raise OptionError(f"round {round} is not in the memory; it has rounds {self.rounds}")
        self.changes += 1
        self.observed_changes += 1
        keep = self.views.round != round
        kept = ViewTable(self.frame, [self.views[int(i)] for i in np.flatnonzero(keep)])
        return self.drop_views(keep, kept, round=round)

    def drop_views(self, keep_view: NDArray[np.bool_], kept: ViewTable, *, round: int) -> int:
        """Remove the views that are not kept, all those of a round; see ``forget``.

        Args:
            keep_view: (views,) bool.
            kept: the table of those that are kept.
            round: number of the round.
        """
        columns, count = self.columns, len(self)
        new_view = (np.cumsum(keep_view) - 1).astype(np.int32)
        keep = keep_view[columns.view]
        new_row = (np.cumsum(keep) - 1).astype(np.int32)
        # Reset confidence to what each observation had in its own round, remove the round's rows
        # and renumber the rest, then repeat what the other rounds added.
        columns.arrays.confidence[:count] = self.own_confidence()
        logs, self.agreements = self.agreements, {}
        columns.replace(int(keep.sum()), lambda name: getattr(columns, name)[keep])
        columns.view[:] = new_view[columns.view]
        self.views = kept
        for number in sorted(set(logs) - {round}):
            for rows, weights, _ in logs[number]:
                self.agree(new_row[rows[keep[rows]]], weights[keep[rows]], round=number)
        # A segment holds one view's observations, so it stays or goes as a whole.
        segments, n = self.segments, self.segments.count
        stays = keep_view[segments.view[:n]]
        self.segments = Segments()
        self.segments.append(
            new_row[segments.start[:n][stays]].astype(np.int64), segments.length[:n][stays],
            new_view[segments.view[:n][stays]], box=segments.box[:n][stays],
        )  # fmt: skip
        self.rebuild_index()
        return count - len(self)

    def rebuild_index(self) -> None:
        """Make the voxel index anew from the observations (after loading or forgetting)."""
        count, columns = len(self), self.columns
        keys, locals_ = np.empty(count, np.int64), np.empty(count, np.uint16)
        inverse = 1.0 / self.voxel
        if voxel_keys(columns.positions, columns.level, inverse, keys, locals_):
            raise OptionError(f"observations lie beyond the reach of voxels of {self.voxel:g}")
        self.index = VoxelIndex()
        self.index.top = int(columns.level.max(initial=0))
        blocks = self.index.block_numbers(keys)
        self.index.reserve_voxels(count, np.unique(blocks))
        link_records(locals_, self.index.arrays, blocks, columns.arrays.next)
        self.index.voxels = int(self.index.block_count[: self.index.blocks].sum())

    def snapshot(self: S) -> S:
        """A read-only view of this memory, for projecting observed content in another thread.

        The arrays are shared, not copied. While it is in use, fuse only generated points into the
        original and forget no round; never fuse into the snapshot. Its generated observations may
        change meanwhile, its observed ones do not.
        """
        other = copy(self)
        other.columns, other.segments = copy(self.columns), copy(self.segments)
        other.views = ViewTable(self.frame, [self.views[i] for i in range(len(self.views))])
        return other

    def recolored(self: S, colors: NDArray[np.uint8]) -> S:
        """A snapshot with other colours (N, 3); nothing else is copied."""
        other = self.snapshot()
        other.columns = self.columns.with_colors(colors)
        return other

    def to(self: S, device: str) -> S:
        """A copy of this memory, independent of it, whose tensors live on a device."""
        other = self.snapshot()
        other.columns = self.columns.to(device)
        other.segments, other.index = deepcopy(self.segments), deepcopy(self.index)
        other.agreements = {round_: list(log) for round_, log in self.agreements.items()}
        return other
