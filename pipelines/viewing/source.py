"""What ``gvtools view`` reads: a run's folder, also while it grows, or a memory alone."""

from __future__ import annotations

import threading
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import GvError, ProjectError
from gvtools.runs.layout import RECORD
from gvtools.runs.memory_file import load_memory
from gvtools.runs.run import Run, count_rounds, load_growing_run
from pipelines.viewing.files import open_file
from pipelines.viewing.gaussians import run_gaussians
from viz.run_view.view import POINTS, RENDERED, SPLATS, RunView, cameras_of

if TYPE_CHECKING:
    from gvtools.scenes.scene import Frame, Scene

KEPT_FRAMES = 8
LOOKS = (POINTS, SPLATS, RENDERED)


class ViewSource:
    """A run or a memory that can be read again and again.

    Args:
        path: a run's folder, a memory file, or what ``gvtools export`` writes.
        project: where the run's project lies now; None: where it lay.
    """

    def __init__(self, path: Path, *, project: Path | None = None) -> None:
        self.path = path
        self.project = project
        self._frames = ProjectFrames(None)

    def rounds(self) -> int:
        """How many complete rounds the folder has; 0 also where there is no folder."""
        return count_rounds(self.path)

    def read(self) -> RunView:
        """The run as it is now."""
        if not (self.path / RECORD).is_file():
            shown = open_file(self.path)
            if shown is not None:
                return shown
            memory = load_memory(self.path).overview()
            cameras = cameras_of(memory, ())
            return RunView(
                self.path, memory, (), cameras, self._frames, None, LOOKS,
                partial(run_gaussians, self.path, memory),
            )  # fmt: skip
        run = load_growing_run(self.path, project=self.project)
        if self._frames.run is None:
            self._frames = ProjectFrames(run)
        try:
            memory = run.memory.overview()
            cameras = cameras_of(memory, run.rounds)
        except GvError as error:
            raise ProjectError(
                f"{self.path}: its rounds' reports hold a camera that is none ({error}); run "
                "reconstruct again"
            ) from None
        return RunView(
            self.path, memory, run.rounds, cameras, self._frames, run.planned, LOOKS,
            partial(run_gaussians, self.path, memory),
        )  # fmt: skip

    def lacking(self) -> str | None:
        """Why the project's own pictures cannot be shown; None when they can."""
        return self._frames.lacking()


class ProjectFrames:
    """The project's pixels by a view's name. The project is opened when it is first asked for.

    Args:
        run: whose project it is; None where there is none.
    """

    def __init__(self, run: Run | None) -> None:
        self.run = run
        self._lock = threading.Lock()
        self._opened = False
        self._scene: Scene | None = None
        self._truths: Scene | None = None
        self._lacking: str | None = None
        # Looking at a camera again, or at another colour of it, is common; a scan would not fit.
        self._load = lru_cache(maxsize=KEPT_FRAMES)(self._load_frame)

    def __call__(self, name: str) -> Frame | None:
        """The pixels of a view; None where the project has none or they cannot be read."""
        self._open()
        return self._load(name)

    def lacking(self) -> str | None:
        """Why there are none at all; None when there are."""
        self._open()
        return self._lacking

    def _open(self) -> None:
        with self._lock:
            if self._opened:
                return
            self._opened = True
            if self.run is None:
                self._lacking = "a memory without a run: no pictures of its cameras"
                return
            try:
                self._scene, self._truths = self.run.scenes
            except (GvError, KeyError, TypeError) as error:
                self._lacking = f"no pictures of the project: {error}"

    def _load_frame(self, name: str) -> Frame | None:
        given = self.run is not None and name in self.run.context
        scene = self._scene if given else self._truths
        if scene is None or name not in scene.names:
            return None
        try:
            return scene[name].load()
        except GvError:
            return None
