"""What pictures are judged against: a run's targets, truths, memory and context.

A project without a run gets one: its context is fused, nothing is fitted and nothing completed, so
that its regions are what the context observed at recorded poses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.runs.layout import RECORD
from gvtools.runs.memory_file import load_memory
from gvtools.runs.poses import refined_poses_of
from gvtools.runs.run import Run, load_run
from gvtools.runs.target_files import to_bytes
from pipelines.console import Console
from pipelines.evaluation.measured_target import MeasuredTarget, context_pictures, run_targets

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class Reference:
    """A run, seen as what other methods' pictures are compared with.

    Attributes:
        run: with a memory.
        cameras: trajectory file with the cameras of the pictures; None takes the run's targets.
    """

    run: Run
    cameras: Path | None = None
    _surfaces: dict[tuple[str, int], NDArray[np.float32]] = field(default_factory=dict, repr=False)

    @cached_property
    def memory(self) -> SpatialMemory:
        """What the context alone gave."""
        return load_memory(self.run.path, up_to=0)

    @cached_property
    def targets(self) -> list[MeasuredTarget]:
        """The targets with the run's own pictures, or the memory's where cameras were given."""
        return run_targets(self.run) if self.cameras is None else self._projected()

    def with_surface(self, target: MeasuredTarget) -> MeasuredTarget:
        """A target with the memory's depth, for a picture without depth of its own."""
        key = target.picture.name, target.number
        if key not in self._surfaces:
            self._surfaces[key] = self.memory.project(target.picture.camera).depth[0]
        return replace(target, surface=self._surfaces[key])

    @property
    def poses(self) -> str:
        """Whose the poses of the targets and the context are."""
        return "recorded" if refined_poses_of(self.run.path) is None else "refined by the run"

    def context(self) -> list[PosedPicture]:
        """The context views with the memory's depth."""
        return context_pictures(self.run, self.memory)

    def _projected(self) -> list[MeasuredTarget]:
        from gvtools.trajectory_files import read_trajectory

        assert self.cameras is not None
        like = self.run.scenes[0].subset(self.run.context).cameras[0]
        targets = []
        for camera in read_trajectory(self.cameras, like):
            seen = self.memory.project(camera)
            picture = PosedPicture(camera.names[0], camera, to_bytes(seen.rgb[0]))
            observed = seen.valid[0] & ~seen.generated[0]
            targets.append(MeasuredTarget(1, picture, observed, ~observed, None))
        return targets


def open_reference(path: Path, *, cameras: Path | None) -> Reference:
    """The run at ``path``.

    Args:
        path: its folder.
        cameras: see Reference.
    """
    run = load_run(path)
    if cameras is None and len(run.rounds) < 2:
        raise ProjectError(
            f"{path}: no round of targets is done; expected one; add --resume to reconstruct"
        )
    return Reference(run, cameras)


def observe_context(
    scene: Scene,
    out: Path,
    *,
    context: str | None,
    targets: str | None,
    cameras: Path | None,
    reading: Mapping[str, Any],
    console: Console,
) -> Reference:
    """Fuse the context of a project, or take up what an earlier call fused.

    Args:
        scene: the project.
        out: folder of the run that keeps the memory.
        context: selection of the given views.
        targets: selection of the views that the pictures stand for.
        cameras: trajectory file with the cameras of the pictures, instead of ``targets``.
        reading: how the user said the project is to be read, JSON-ready.
        console: where progress goes.
    """
    from gvtools.runs.folder import RunDirectory
    from gvtools.settings import with_values
    from pipelines.reconstruction.run import reconstruct
    from pipelines.reconstruction.settings import RunSettings

    if context is None or (targets is None and cameras is None):
        raise OptionError(
            "--against a project: expected --context with the views that the methods were given, "
            "and --targets with those that the pictures stand for; or give a finished run"
        )
    values = {
        "context": context,
        "targets": targets if cameras is None else str(cameras),
        # One round: nothing is added to the memory between the targets.
        "views_per_round": max(len(scene), 1) if cameras is None else 1_000_000,
        "completer": "none",
        "refine.steps": 0,
        # Where other methods were told that the cameras stand.
        "refine.poses": False,
    }
    resume = (out / RECORD).is_file()
    RunDirectory(out).refuse_foreign()
    config = with_values(RunSettings(), values)
    console.line(f"fusing the context into {out}")
    # What a run says of the memory's own pictures would be mistaken for a judgement.
    quiet = Console(quiet=True)
    reconstruct(scene, config, out, console=quiet, resume=resume, reading=reading)
    return Reference(load_run(out))
