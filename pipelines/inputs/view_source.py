"""What ``gvtools view`` reads: a run's folder, also while it grows, or a memory alone."""

from __future__ import annotations

import threading
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import GvError, MemoryFileError, ProjectError
from gvtools.runs.finished import open_scenes, read_record, read_reports
from gvtools.runs.folder import RunDirectory
from pipelines.rendering.memory_source import open_memory
from viz.run_view.view import RunView, cameras_of

if TYPE_CHECKING:
    from gvtools.scenes.scene import Frame, Scene

# How often a memory is looked for that the run is just putting elsewhere.
ATTEMPTS = 5
KEPT_FRAMES = 8


class ViewSource:
    """A run or a memory that can be read again and again.

    Args:
        path: a run's folder, a memory file or a coloured PLY.
        project: where the run's project lies now; None: where it lay.
    """

    def __init__(self, path: Path, *, project: Path | None = None) -> None:
        self.path = path
        self.project = project
        self._frames = ProjectFrames({}, None)

    def rounds(self) -> int:
        """How many whole rounds the folder has; 0 also where there is no folder."""
        return len(RunDirectory(self.path).reports())

    def read(self) -> RunView:
        """The run as it is now.

        Raises:
            GvError: no run or memory, a damaged file.
        """
        if not self.path.is_dir():
            memory = open_memory(self.path)
            return RunView(self.path, memory, (), cameras_of(memory, ()), self._frames)
        record = read_record(self.path) if (self.path / "run.json").is_file() else {}
        for attempt in range(ATTEMPTS):
            reports = read_reports(self.path)
            try:
                memory = open_memory(self.path)
            except MemoryFileError:
                # The next round is done, and this one's memory gone.
                if attempt == ATTEMPTS - 1 or len(reports) == self.rounds():
                    raise
                continue
            if len(reports) == self.rounds():
                break
        if not self._frames.record:
            self._frames = ProjectFrames(record, self.project)
        planned = len(record["schedule"]) + 1 if "schedule" in record else None
        try:
            cameras = cameras_of(memory, reports)
        except GvError as error:
            raise ProjectError(
                f"{self.path}: its rounds' reports hold a camera that is none ({error}); run "
                "reconstruct again"
            ) from None
        return RunView(self.path, memory, reports, cameras, self._frames, planned)

    def lacking(self) -> str | None:
        """Why the project's own pictures cannot be shown; None when they can."""
        return self._frames.lacking()


class ProjectFrames:
    """The project's pixels by a view's name. The project is opened when it is first asked for.

    Args:
        record: what run.json holds; empty where there is none.
        project: where the project lies now; None: where it lay.
    """

    def __init__(self, record: dict[str, Any], project: Path | None) -> None:
        self.record = record
        self._project = project
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
            if not self.record:
                self._lacking = "a memory without a run: no pictures of its cameras"
                return
            try:
                self._scene, self._truths = open_scenes(self.record, project=self._project)
            except (GvError, KeyError, TypeError) as error:
                self._lacking = f"no pictures of the project: {error}"

    def _load_frame(self, name: str) -> Frame | None:
        scene = self._scene if name in self.record.get("context", ()) else self._truths
        if scene is None or name not in scene.names:
            return None
        try:
            return scene[name].load()
        except GvError:
            return None
