"""A memory's state: its options, frame, views, and the tiles that hold its observations."""

from __future__ import annotations

import re
from collections.abc import Iterable
from copy import copy
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator

from gvtools.errors import OptionError
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.observations import AgreementEntry, Columns, Observations
from gvtools.memory.store.tile_set import TileSet
from gvtools.memory.store.views import FreeGrid, ViewTable
from gvtools.memory.store.voxel_index import MAX_VOXEL, VoxelLevels, check_grid
from gvtools.notebook import html_table
from gvtools.settings import Settings

if TYPE_CHECKING:
    import open3d as o3d

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


def bytes_of(text: str) -> int:
    """A number of bytes from text.

    >>> bytes_of("4GB"), bytes_of("1.5 GiB"), bytes_of("1000000")
    (4000000000, 1610612736, 1000000)
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(?:([KMGT])(I?))?B?", text.strip().upper())
    if not found:
        raise ValueError("a number of bytes such as 4GB, 400MB or 2GiB")
    power = " KMGT".index(found[2]) if found[2] else 0
    return round(float(found[1]) * (1024 if found[3] else 1000) ** power)


class Store:
    """Observations in voxels, the views they come from, and the confidence that rounds added.

    It grows and forgets; it knows nothing of fusion, projection or files.

    Args:
        voxel: edge of the finest voxels, scene units.
        origin: (3,) float64 world point that positions are held relative to, so that float32
            keeps millimetres in a georeferenced scene.
        axes: (3, 3) rotation whose columns are the voxel grid's axes in the world frame; None for
            the world's own. See LocalFrame.
        device: where the tensors live, "cpu" or "cuda:0". What runs on the CPU (fusing, forgetting,
            the cpu and one-pixel back ends) needs them there, see ``to``; elsewhere the torch back
            end projects them and Open3D uses them.
    """

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
        self.views = ViewTable(self.frame)
        self.levels = VoxelLevels(self.voxel, self.options.voxels_per_footprint)
        # How often something was fused or forgotten, and how often that touched observed content.
        self.changes = self.observed_changes = 0
        self.hold(Observations(self.voxel, self.options.weight_cap, device))

    def hold(self, whole: Observations) -> None:
        """Keep these observations, in one tile in RAM."""
        self.tiles = TileSet(whole, self.views)
        # Of all observations, in RAM.
        self.segments = whole.segments

    @property
    def in_ram(self) -> bool:
        """Whether all observations are in RAM, in one tile."""
        return self.tiles.whole is not None

    @property
    def whole(self) -> Observations:
        """All observations; refused where they are in tiles on disk."""
        if self.tiles.whole is None:
            raise OptionError(
                f"the memory's {len(self):,} observations are in tiles on disk, larger than its "
                "budget; take memory.overview(MOST) for at most so many of them in RAM, or raise "
                "memory.budget"
            )
        return self.tiles.whole

    @property
    def columns(self) -> Columns:
        """The observations as columns."""
        return self.whole.columns

    @property
    def agreements(self) -> dict[int, list[AgreementEntry]]:
        """By round, what its views added to the confidence of earlier rounds' observations."""
        return self.whole.agreements

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
        return self.tiles.voxels

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
        return self.stored_bytes + sum(view.free_depth.nbytes for view in self.views)

    @property
    def stored_bytes(self) -> int:
        """Bytes of the observations, their segments, index and agreements, in RAM or not."""
        return self.tiles.size + (0 if self.in_ram else self.segments.nbytes)

    @property
    def generated_count(self) -> int:
        """Number of observations that a completer made."""
        rows = self.segments.rows()
        return int(rows["length"][self.views.generated[rows["view"]]].sum(dtype=np.int64))

    @property
    def scanned_count(self) -> int:
        """Number of observations that a scan brought."""
        rows = self.segments.rows()
        return int(rows["length"][self.views.scanned[rows["view"]]].sum(dtype=np.int64))

    def __len__(self) -> int:
        """Number of stored observations."""
        return self.segments.observations

    def __repr__(self) -> str:
        generated, scanned = self.generated_count, self.scanned_count
        apart = f"{generated:,} generated" + (f", {scanned:,} scanned" if scanned else "")
        device = self.columns.device if self.in_ram else "cpu"
        where = "" if device == "cpu" else f" on {device}"
        return (
            f"{type(self).__name__}({len(self):,} observations ({apart}) in "
            f"{self.voxels:,} voxels of {self.voxel:g}, {len(self.views)} views, "
            f"rounds {self.rounds!r}, {self.nbytes / 2**20:.1f} MiB{where})"
        )

    def _repr_html_(self) -> str:
        rows = {
            "observations": f"{len(self):,}",
            "of these generated": f"{self.generated_count / max(len(self), 1):.1%}",
            "scanned": f"{self.scanned_count:,}",
            "voxels": f"{self.voxels:,} of edge {self.voxel:g}",
            "views": len(self.views),
            "rounds": ", ".join(map(str, self.rounds)),
            "size": f"{self.nbytes / 2**20:.1f} MiB",
        }
        return html_table(type(self).__name__, rows)

    def observed_grids(self, rows: Iterable[int] | None = None) -> list[FreeGrid]:
        """(K, cam_from_local, free_depth) of those views in ``rows``, or of all, not generated."""
        views = self.views
        return [
            (views[i].camera.K[0], views.cam_from_local[i], views[i].free_depth)
            for i in (range(len(views)) if rows is None else rows)
            if not views.generated[i]
        ]

    def own_confidence(self) -> NDArray[np.float32]:
        """(N,) float32, a copy: confidence without what later rounds added."""
        return self.whole.own_confidence()

    def forget(self, *, round: int) -> int:
        """Undo a round; returns how many observations were removed.

        Its views and the confidence it added elsewhere go, too. After the last round is forgotten,
        the memory is bit for bit what it was before it. When an earlier round is forgotten, later
        ones keep what they stored.
        """
        if round not in self.rounds:
            raise OptionError(f"round {round} is not in the memory; it has rounds {self.rounds}")
        self.changes += 1
        self.observed_changes += 1
        before, keep = len(self), self.views.round != round
        if self.in_ram:
            self.whole.drop_views(keep, round=round)
            self.segments = self.whole.segments
        else:
            self.tiles.drop_views(self.segments, keep, round=round)
            self.segments = self.segments.without_views(keep)
        self.views.select(keep)
        return before - len(self)

    def page_if_large(self) -> None:
        """Move to tiles if half of the budget is used."""
        self.segments = self.tiles.page() or self.segments

    def compact(self) -> int:
        """Join small neighbouring tiles, as after ``forget``; returns how many fewer there are."""
        with self.tiles.lock:
            return self.tiles.join_small()

    def close(self) -> None:
        """Remove what a memory in tiles keeps on disk beside what was saved; nothing in RAM."""
        self.tiles.close()

    def _copy(self: S, whole: Observations | None = None) -> S:
        """This memory with a view table of its own, and with other observations in RAM."""
        other = copy(self)
        other.views = ViewTable(self.frame, self.views)
        if whole is None:
            other.segments = copy(self.segments)
        else:
            other.hold(whole)
            other.tiles.budget, other.tiles.scratch = self.tiles.budget, self.tiles.scratch
        return other

    def __deepcopy__(self: S, _: dict[int, Any]) -> S:
        return self.to(self.columns.device)

    def snapshot(self: S) -> S:
        """A read-only view of this memory, for projecting observed content in another thread.

        The arrays are shared, not copied. While it is in use, fuse only generated points into the
        original and forget no round; never fuse into the snapshot. Its generated observations may
        change meanwhile, its observed ones do not.
        """
        return self._copy(self.whole.snapshot() if self.in_ram else None)

    def recolored(self: S, colors: NDArray[np.uint8]) -> S:
        """A snapshot with other colours (N, 3); nothing else is copied."""
        whole = self.whole.snapshot()
        whole.columns = self.columns.with_colors(colors)
        return self._copy(whole)

    def to(self: S, device: str) -> S:
        """A copy of this memory, independent of it, whose tensors live on a device."""
        return self._copy(self.whole.to(device))
