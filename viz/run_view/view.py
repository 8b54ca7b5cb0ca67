"""What viewers show of a run: its memory, its rounds, its cameras and their pictures.

Nothing here knows a viewer; the web page and the Open3D window stand on the same data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.runs.layout import AFTER, COMPLETION, GUIDANCE, round_folder
from gvtools.runs.target_files import entry_camera, read_picture
from viz.run_view.gaussians import ShownGaussians, Surface
from viz.run_view.point_colors import PointColors, point_colors, view_counts
from viz.run_view.upright import STRAY, guessed_up

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Frame

CONTEXT, TARGET = "context", "target"
# The pictures that a round leaves of a target, by the title that a viewer gives them.
PICTURES = {"guidance": GUIDANCE, "completion": COMPLETION, "memory after": AFTER}
TRUTH = "truth"
# How a viewer may show it: as points, as the Gaussians of an export, as the project's own splatter
# renders it, or as a file's mesh.
POINTS, SPLATS, RENDERED, MESH = "points", "splats", "rendered", "mesh"


@dataclass(frozen=True, eq=False)
class ShownCamera:
    """A camera of a run.

    Attributes:
        name: of its view.
        kind: "context" (its picture was given) or "target" (its picture was completed).
        round: the round it was fused or completed in.
        camera: a batch of one.
        stem: part of the names of the files that its round left; None where there are none.
        coverage: the shares of its pixels that memory supports before and after the round.
    """

    name: str
    kind: str
    round: int
    camera: Cameras
    stem: str | None = None
    coverage: tuple[float, float] | None = None


@dataclass(frozen=True)
class Counts:
    """What the memory holds after a round: observations by their source, and voxels if known."""

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
class RunView:
    """A run, or a memory without one, as it is now.

    Attributes:
        path: the run's folder, or the memory file.
        memory: after the last whole round.
        reports: of the whole rounds, in order; none for a memory file.
        cameras: context first, then targets, in the order of rounds.
        frame_of: the project's pixels of a view by its name; None where it has none.
        planned: how many rounds, the context's included, the run is to have; None if unknown.
        looks: of POINTS, SPLATS, RENDERED and MESH, those that there are; the first to begin with.
        gaussians_of: the Gaussians to draw for SPLATS, so many of the memory's points at most.
        surface: to draw for MESH.
    """

    path: Path
    memory: SpatialMemory
    reports: tuple[Mapping[str, Any], ...]
    cameras: tuple[ShownCamera, ...]
    frame_of: Callable[[str], Frame | None]
    planned: int | None = None
    looks: tuple[str, ...] = (POINTS, RENDERED)
    gaussians_of: Callable[[int], ShownGaussians] | None = None
    surface: Surface | None = None

    @property
    def title(self) -> str:
        """A name for windows and pages."""
        return self.path.resolve().name

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
        """What there is to see of a camera, by title.

        Returns:
            (H, W, 3) uint8 each: for a target "guidance" (holes black), "completion" and "memory
            after", for any camera "truth", the project's picture. What is absent is left out.
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
        """(3,) unit vector, world frame: what most of the context's cameras hold to be up.

        Without cameras it is a guess, see guessed_up.
        """
        chosen = [c for c in self.cameras if c.kind == CONTEXT] or list(self.cameras)
        if not chosen:
            return self._guessed_up
        # Image rows run downwards.
        total = -np.sum([c.camera.cam_from_world[0, 1, :3] for c in chosen], axis=0)
        length = float(np.linalg.norm(total))
        return total / length if length > 1e-6 else -chosen[0].camera.cam_from_world[0, 1, :3]

    @cached_property
    def _view_counts(self) -> NDArray[np.int64]:
        return view_counts(self.memory)

    @cached_property
    def _guessed_up(self) -> NDArray[np.float64]:
        return guessed_up(self.memory.frame.to_world(self._sample()[1]))

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
