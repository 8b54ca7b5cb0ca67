"""Contents of an export: points, Gaussians and cameras of a run or a memory.

Gaussians are those that the run fitted, which show what photographs saw. Of the memory's points,
generated ones are added, and scanned ones that have no photograph's observation near them. Without
a fit all points are exported. Each point becomes a spherical Gaussian.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.gaussians import Gaussians
from gvtools.cameras import Cameras, concatenate
from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.voxel_index import levels_above
from gvtools.memory.thinning import thin
from gvtools.runs.run import load_appearance, load_run
from gvtools.runs.target_files import completed_picture
from gvtools.splats import LOG_SCALE, LOGIT, SH, Splats, box_middle, near_origin, turn_gaussians
from gvtools.trajectories import level_up
from pipelines.export.formats import ExportOptions

if TYPE_CHECKING:
    from gvtools.appearance.appearance import Appearance
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import View

# Standard deviation of a point's Gaussian, as a share of the distance to the next point.
SPREAD = 0.6
# Opacity of a point at confidence 0, and towards which it grows with confidence.
LEAST_OPACITY, MOST_OPACITY = 0.7, 0.99
# Confidence at which the opacity is half-way between them.
HALFWAY = 0.5


@dataclass(frozen=True, eq=False)
class ExportPoints:
    """P points of a memory, one a voxel."""

    rows: NDArray[np.int64]  # (P,) their observations in the memory
    positions: NDArray[np.float64]  # (P, 3) world frame, scene units
    colors: NDArray[np.uint8]  # (P, 3)
    edge: float  # of the voxels that they were thinned to, scene units

    @property
    def middle(self) -> NDArray[np.float64]:
        """(3,) the middle of the box around them."""
        return box_middle(self.positions)


@dataclass(frozen=True, eq=False)
class DistinctCameras:
    """Each camera of a memory once, under a name of its own."""

    cameras: Cameras
    # (views of the memory,) which of the cameras each view has; -1 for a scan's station.
    row_of_view: NDArray[np.int64]
    # Those that a completer alone saw through, in order, with the pictures that the run kept.
    generated: dict[str, Path | None]


@dataclass(frozen=True, eq=False)
class ExportSource:
    """A run, or a memory alone."""

    path: Path  # a run's folder, or a memory file
    memory: SpatialMemory  # with at least one observation
    up_to: int | None = None  # round that the memory ends with; None for the last one
    told_up: NDArray[np.float64] | None = None  # (3,) unit vector, by the user

    @cached_property
    def appearance(self) -> Appearance | None:
        """The Gaussians that the run fitted; None where it has none."""
        return load_appearance(self.path)

    @cached_property
    def project(self) -> Mapping[str, View]:
        """The views of the run's project by name; none where it cannot be read (any more)."""
        with suppress(GvError):
            return {view.name: view for view in load_run(self.path).scenes[0]}
        return {}

    @property
    def up(self) -> NDArray[np.float64] | None:
        """(3,) unit vector, world frame: told, or the photographs'; None where they tell none."""
        cameras = [view.camera for view in self.memory.views.photographed]
        if self.told_up is not None or not cameras:
            return self.told_up
        up = level_up(concatenate(cameras))
        return up if up.any() else None

    def points(
        self,
        options: ExportOptions,
        *,
        most: int | None = None,
        among: NDArray[np.bool_] | None = None,
    ) -> ExportPoints:
        """The most confident observation of each voxel.

        ``most`` counts where the user gave no number; ``among`` (N,) are the observations to take.
        """
        memory = self.memory
        chosen = np.ones(len(memory), np.bool_) if among is None else among
        if options.observed:
            chosen = chosen & ~memory.generated
        if not chosen.any():
            raise OptionError(f"--observed: nothing in {self.path} was observed; leave it out")
        limit = most if options.max_points is None else options.max_points
        kept = thin(memory, limit, among=chosen)
        columns = memory.columns
        positions = memory.frame.to_world(columns.positions[kept.rows])
        return ExportPoints(kept.rows, positions, columns.colors[kept.rows], kept.edge)

    def points_summary(self, points: ExportPoints) -> str:
        """How many points there are, for the user."""
        return (
            f"{len(points.rows)} points of {len(self.memory)} observations (voxels of "
            f"{points.edge:.4g})"
        )

    def splats(self, options: ExportOptions, *, exposed: bool = True) -> Splats:
        """The Gaussians that show the run or the memory; ``exposed`` bakes in exposures."""
        appearance, memory = self.appearance, self.memory
        if appearance is None:
            values, rounds, generated = self._point_gaussians(options)
            values, origin = near_origin(values, memory.frame.origin)
            # One colour each.
            return Splats(values[:, : SH + 3], origin, 0, 0, rounds, generated, self.up)
        first = appearance.gaussians
        if exposed and appearance.exposures is not None:
            from gvtools.appearance.camera_corrections import expose

            photographs = concatenate([view.camera for view in memory.views.photographed])
            first = expose(first, appearance.exposures, photographs)
        fitted, rest = turn_gaussians(first.values, first.frame.axes), None
        parts = [(fitted, np.zeros(len(fitted), np.int32), np.zeros(len(fitted), np.bool_))]
        if options.max_points is not None:
            rest = options.max_points - len(fitted)
            if rest < 0:
                raise OptionError(
                    f"--max-points {options.max_points}: the run's fit has {len(fitted)} "
                    "Gaussians, which are kept whole; expected no less"
                )
        further = unphotographed(memory)
        if not options.observed:
            # Of round 0, that is the fit's own depth, which its Gaussians show already.
            further |= memory.generated & (memory.columns.round > 0)
        if further.any() and rest != 0:
            more = self._point_gaussians(ExportOptions(max_points=rest), among=further)
            more[0][:, :LOG_SCALE] += (memory.frame.origin - first.frame.origin).astype(np.float32)
            parts.append(more)
        values, rounds, generated = (np.concatenate(each) for each in zip(*parts, strict=True))
        values, origin = near_origin(values, first.frame.origin)
        others = len(appearance.others)
        return Splats(values, origin, len(fitted), others, rounds, generated, self.up)

    def _point_gaussians(
        self, options: ExportOptions, *, among: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.bool_]]:
        """Spherical Gaussians of the memory's points, one a voxel, with round and ``generated``.

        Their size follows from the distance between points, their opacity from confidence. Axes
        are the world's, positions relative to the memory's origin.
        """
        memory = self.memory
        points = self.points(options, among=among)
        columns = memory.columns
        # The next point is at least about a voxel's edge away: each voxel has one.
        above = levels_above(columns.level[points.rows], points.edge / memory.voxel)
        edges = np.ldexp(points.edge, above)
        apart = np.maximum(columns.spacing[points.rows], edges)
        local = points.positions - memory.frame.origin
        gaussians = Gaussians.at(
            local, points.colors, sizes=SPREAD * apart, frame=LocalFrame.at(memory.frame.origin)
        )
        confidence = memory.confidence[points.rows]
        share = confidence / (confidence + HALFWAY)
        opacity = LEAST_OPACITY + (MOST_OPACITY - LEAST_OPACITY) * share
        gaussians.values[:, LOGIT] = np.log(opacity / (1 - opacity))
        rounds = columns.round[points.rows].astype(np.int32)
        return gaussians.values, rounds, memory.generated[points.rows]

    def cameras(self) -> DistinctCameras:
        """Each camera once, as formats of other tools need it, each with a unique name.

        A view may be fused twice. Observed cameras keep their names; generated ones are named
        ``generated/NAME``, or ``generated_2/NAME`` and so on where another has that in any case.
        """
        memory = self.memory
        cameras, made = memory.views.cameras, memory.views.generated
        taken = np.flatnonzero(~memory.views.scanned)
        if cameras is None or not len(taken):
            raise ProjectError("the memory has no views; nothing to export")
        first: list[int] = []  # for each camera kept the first view that has it
        names: list[str] = []
        rows_of_name: dict[str, list[int]] = {}
        row_of_view = np.full(len(cameras), -1, np.int64)
        used: set[str] = set()
        # Observed views come first and keep their names.
        for i in taken[np.argsort(made[taken], kind="stable")].tolist():
            name = cameras.names[i]
            alike = rows_of_name.setdefault(name, [])
            row = next((row for row in alike if _same_camera(memory, first[row], i)), len(first))
            row_of_view[i] = row
            if row < len(first):
                continue
            if alike and not made[i]:
                raise ProjectError(
                    f"two different observed cameras of the memory are named {name!r}; formats of "
                    "other tools need unique names; rename one in the project and run again"
                )
            if made[i]:
                name = next(new for new in _generated_names(name) if new.lower() not in used)
            alike.append(row)
            first.append(i)
            names.append(name)
            used.add(name.lower())
        kept = replace(cameras[first], names=tuple(names))
        pictures: dict[str, Path | None] = {}
        for i, row in enumerate(row_of_view.tolist()):
            if row >= 0 and made[first[row]]:
                # Of several rounds' pictures the last.
                view = memory.views[i]
                picture = completed_picture(self.path, view.round, view.camera.names[0])
                pictures[names[row]] = picture or pictures.get(names[row])
        return DistinctCameras(kept, row_of_view, pictures)


def unphotographed(memory: SpatialMemory) -> NDArray[np.bool_]:
    """(N,) scanned observations without a photograph's observation within their spacing."""
    scanned = memory.scanned
    seen = ~(scanned | memory.generated)
    if not scanned.any() or not seen.any():
        return scanned.copy()
    from scipy.spatial import KDTree

    positions, rows = memory.columns.positions, np.flatnonzero(scanned)
    away, _ = KDTree(positions[seen]).query(positions[rows], workers=-1)
    alone = np.zeros(len(memory), np.bool_)
    alone[rows[away > memory.columns.spacing[rows]]] = True
    return alone


def _generated_names(name: str) -> Iterator[str]:
    yield f"generated/{name}"
    yield from (f"generated_{number}/{name}" for number in count(2))


def _same_camera(memory: SpatialMemory, i: int, j: int) -> bool:
    """Whether two views of the memory have one camera, up to rounding."""
    first, second = memory.views[i].camera, memory.views[j].camera
    # Relative to the memory's origin: in a far world frame a tolerance would swallow a step aside.
    pose = memory.views.cam_from_local
    return bool(
        (first.width == second.width).all()
        and (first.height == second.height).all()
        and np.allclose(pose[i], pose[j])
        and np.allclose(first.K, second.K)
    )
