"""A run as viewers show it: memory, rounds, cameras and their pictures, Gaussians, level of detail.

Nothing here knows a viewer; the web page, the Open3D window and screenshots stand on the same data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate
from gvtools.errors import ProjectError
from gvtools.runs.layout import AFTER, COMPLETION, GUIDANCE, round_folder
from gvtools.runs.target_files import entry_camera, read_picture
from gvtools.trajectories import level_up
from viz.viewer.colors import CONTEXT, TARGET, PointColors, point_colors, view_counts
from viz.viewer.standpoint import STRAY, guess_up

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Frame
    from viz.page.page import SharedPage

# The pictures that a round leaves of a target, by the title that a viewer gives them.
PICTURES = {"guidance": GUIDANCE, "completion": COMPLETION, "memory after": AFTER}
TRUTH = "truth"
# Looks: points, Gaussians as the page to share draws them, as the project's own splatter renders
# it, a file's mesh.
POINTS, SPLATS, RENDERED, MESH = "points", "splats", "rendered", "mesh"
# Bits of a cell's place along an axis: three of them, and two for the source, fit a signed 64-bit
# key.
AXIS_BITS = 20


@dataclass(frozen=True, eq=False)
class ShownCamera:
    """A camera of a run."""

    name: str  # of its view
    kind: str  # CONTEXT (its picture was given) or TARGET (its picture was completed)
    round: int  # that it was fused or completed in
    camera: Cameras  # a batch of one
    stem: str | None = None  # part of the names of the files that its round left, if any
    # The shares of its pixels that memory supports before and after the round.
    coverage: tuple[float, float] | None = None


@dataclass(frozen=True)
class Counts:
    """Observations of a memory after a round by their source, and voxels if known."""

    observed: int
    generated: int
    voxels: int | None
    scanned: int = 0

    @property
    def total(self) -> int:
        """All observations."""
        return self.observed + self.generated + self.scanned

    def summary(self) -> str:
        """How many there are of each source, in words."""
        scanned = f"{self.scanned:,} scanned, " if self.scanned else ""
        return f"{self.observed:,} observed, {scanned}{self.generated:,} generated"


@dataclass(frozen=True, eq=False)
class ColoredMesh:
    """Triangles with colours at their vertices."""

    vertices: NDArray[np.float64]  # (V, 3) world frame, scene units
    faces: NDArray[np.int64]  # (F, 3) rows of ``vertices``
    colors: NDArray[np.uint8]  # (V, 3)


@dataclass(frozen=True, eq=False)
class RunView:
    """A run, or a memory without one, as it is now."""

    path: Path  # the run's folder, or the memory file
    memory: SpatialMemory  # after the last whole round
    # Of the whole rounds, in order; none for a memory file.
    reports: tuple[Mapping[str, Any], ...] = ()
    cameras: tuple[ShownCamera, ...] = ()  # context first, then targets, in the order of rounds
    # The project's pixels of a view by its name; None where it has none.
    frame_of: Callable[[str], Frame | None] = lambda name: None
    planned: int | None = None  # rounds that the run is to have, the context's included
    looks: tuple[str, ...] = (POINTS, RENDERED)  # that there are; the first to begin with
    # The page that draws SPLATS, with so many of the memory's points at most beside a fit.
    page_of: Callable[[RunView, int], SharedPage] | None = None
    surface: ColoredMesh | None = None  # to draw for MESH
    told_up: NDArray[np.float64] | None = None  # (3,) unit vector, by a file or the user

    @property
    def title(self) -> str:
        """A name for windows and pages, text also where the folder's is none."""
        return self.path.resolve().name.encode(errors="backslashreplace").decode()

    @property
    def last_round(self) -> int:
        """The number of the last whole round."""
        return max(len(self.reports) - 1, *self.memory.rounds, 0)

    @property
    def whole(self) -> bool:
        """Whether no more rounds are to come."""
        return self.planned is None or len(self.reports) >= self.planned

    def round_of_points(self) -> NDArray[np.int32]:
        """(N,) int32, for each observation the round it was fused in."""
        memory = self.memory
        return memory.views.round[memory.columns.view[: len(memory)]]

    def counts(self, round: int) -> Counts:
        """What the memory held after a round.

        Without a report, counted in the memory; voxels are then known for the last round alone.
        """
        if round < len(self.reports):
            report = self.reports[round]
            return Counts(
                report["observed"], report["generated"], report["voxels"], report.get("scanned", 0)
            )
        there = self.round_of_points() <= round
        generated = int((self.memory.generated & there).sum())
        scanned = int((self.memory.scanned & there).sum())
        voxels = self.memory.voxels if round >= self.last_round else None
        return Counts(int(there.sum()) - generated - scanned, generated, voxels, scanned)

    def colors(self, mode: str, rows: NDArray[np.int64]) -> PointColors:
        """Colours of observations, those in ``rows`` (P,), see point_colors."""
        counts = self._view_counts if mode == "views" else None
        return point_colors(
            self.memory, mode, rows=rows, true_depth=self.recorded_depth, counts=counts
        )

    def pictures(self, shown: ShownCamera) -> dict[str, NDArray[np.uint8]]:
        """(H, W, 3) pictures of a camera by title; what is absent is left out.

        For a target "guidance" (holes black), "completion" and "memory after", for any camera
        "truth", the project's picture.
        """
        out = {}
        if shown.stem is not None:
            folder = round_folder(self.path, shown.round)
            for title, kind in PICTURES.items():
                try:
                    out[title] = read_picture(folder, kind, shown.stem)
                except FileNotFoundError:
                    continue
                except (OSError, SyntaxError) as error:
                    raise ProjectError(
                        f"{folder}: the {title} of {shown.name} is no readable picture ({error})"
                    ) from error
        frame = self.frame_of(shown.name)
        if frame is not None:
            out[TRUTH] = frame.rgb
        return out

    def recorded_depth(self, name: str) -> NDArray[np.float32] | None:
        """(H, W) float32 z-depth that the project has of a view, scene units, 0 = none."""
        frame = self.frame_of(name)
        return None if frame is None else frame.depth

    def up(self) -> NDArray[np.float64]:
        """(3,) unit vector, world frame: what is told, or the cameras' vertical, or a guess."""
        if self.told_up is not None:
            return self.told_up
        chosen = [c for c in self.cameras if c.kind == CONTEXT] or self.cameras
        up = level_up(concatenate([c.camera for c in chosen])) if chosen else np.zeros(3)
        return up if up.any() else self._guessed_up

    @cached_property
    def _view_counts(self) -> NDArray[np.int64]:
        return view_counts(self.memory)

    @cached_property
    def _guessed_up(self) -> NDArray[np.float64]:
        return guess_up(self.memory.frame.to_world(self._sample()[1]))

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) the least and the greatest coordinates, world frame; stray points left out."""
        _, local = self._sample()
        if not len(local):
            return np.zeros((2, 3))
        world = self.memory.frame.to_world(local)
        return np.percentile(world, [STRAY, 100 - STRAY], axis=0)

    def _sample(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Rows of some observations, and where they are, (P, 3) in the memory's frame."""
        memory = self.memory
        rows = np.arange(0, len(memory), max(1, len(memory) // 100_000))
        return rows, memory.columns.positions[rows]

    @cached_property
    def typical_depth(self) -> float:
        """The median distance of observations from the camera that saw them, scene units."""
        rows, positions = self._sample()
        if not len(rows):
            return 1.0
        away = positions - self.memory.views.centers[self.memory.columns.view[rows]]
        return float(np.median(np.linalg.norm(away, axis=1))) or 1.0


def cameras_of(
    memory: SpatialMemory, reports: Sequence[Mapping[str, Any]]
) -> tuple[ShownCamera, ...]:
    """The context's cameras as the memory holds them, and the targets' as the reports do.

    Without reports, generated views of the memory stand for the targets. A view without a picture
    size (of a PLY) is left out.
    """
    views = [memory.views[i] for i in range(len(memory.views))]
    out = [
        ShownCamera(
            view.camera.names[0], TARGET if view.generated else CONTEXT, view.round, view.camera
        )
        for view in views
        if int(view.camera.width[0]) > 1 and not (view.generated and reports)
    ]
    for report in reports[1:]:
        for entry in report["views"]:
            coverage = (float(entry["coverage"]), float(entry["coverage_after"]))
            camera, number = entry_camera(entry), report["round"]
            out.append(ShownCamera(entry["name"], TARGET, number, camera, entry["stem"], coverage))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Detail:
    """The observations to draw."""

    rows: NDArray[np.int64]  # (P,) ascending
    edge: float  # of the cells that were thinned to, scene units; 0 when nothing was left out
    size: float  # edge of the square to draw a point as, scene units


def detail(memory: SpatialMemory, budget: int) -> Detail:
    """At most ``budget`` observations, spread evenly in space.

    Of each cell the first observation is taken, one of each source: so a later round never changes
    what is drawn of earlier ones, unless cells have to grow, and generated content stays visible
    beside observed content. Cells grow from the memory's voxels.
    """
    count = len(memory)
    spacing = memory.columns.spacing[:count][:: max(1, count // 100_000)]
    size = float(np.median(spacing)) if count else memory.voxel
    if count <= budget:
        return Detail(np.arange(count), 0.0, size)
    positions = memory.columns.positions
    reach = float(np.abs(positions).max())
    edge = max(memory.voxel, reach / 2 ** (AXIS_BITS - 2))
    while True:
        keys = (_cell_keys(positions, edge) << 2) | memory.generated | (memory.scanned << 1)
        _, first = np.unique(keys, return_index=True)
        # Cells that meet at the origin do not become one however large they are.
        if len(first) <= budget or edge > reach:
            return Detail(np.sort(first)[:budget], edge, max(size, edge))
        edge *= max(1.1, float(np.sqrt(len(first) / budget)))


def _cell_keys(positions: NDArray[np.float32], edge: float) -> NDArray[np.int64]:
    """(N,) int64 below 2⁶⁰, equal for positions (N, 3) of one cell."""
    keys = np.zeros(len(positions), np.int64)
    for axis in positions.T:
        # Times the inverse, as the memory counts its voxels.
        cell = np.floor(axis * (1.0 / np.float64(edge))).astype(np.int64)
        keys = (keys << AXIS_BITS) | (cell - cell.min())
    return keys
