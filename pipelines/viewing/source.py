"""Sources of ``gvtools view``: a run's folder, also while it grows, a memory, or an exported file.

An exported file becomes a memory of its points, and keeps its Gaussians or its mesh beside it. Axes
are the file's; Gaussians that an export turned upright are turned back to the input's.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError, MemoryFileError, OptionError, ProjectError
from gvtools.glb import GLTF_ENDS
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.optional import require
from gvtools.ply import read_header
from gvtools.runs.layout import RECORD
from gvtools.runs.run import Run, count_rounds, load_growing_run, load_memory
from gvtools.splat_files import READERS, USD_ENDS, holds_splats, read_splats
from gvtools.splats import LOG_SCALE, QUATERNION
from pipelines.export.formats import ExportOptions
from pipelines.export.html import page_of
from pipelines.export.source import ExportSource
from pipelines.viewing.readers import GREY, load_mesh, read_usd, told_up
from viz.viewer.run_view import MESH, POINTS, RENDERED, SPLATS, ColoredMesh, RunView, cameras_of

if TYPE_CHECKING:
    import trimesh

    from gvtools.scenes.scene import Frame, Scene
    from viz.page.page import SharedPage

KEPT_FRAMES = 8


class ViewSource:
    """A run or a memory that can be read again and again.

    ``path`` is a run's folder, a memory file, or what ``gvtools export`` writes; ``project`` where
    the run's project lies now, None: where it lay.
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
            return replace(self._run_view(load_memory(self.path)), told_up=told_up(self.path))
        run = load_growing_run(self.path, project=self.project)
        if self._frames.run is None:
            self._frames = ProjectFrames(run)
        try:
            return self._run_view(run.memory, run.rounds, planned=run.planned)
        except GvError as error:
            raise ProjectError(
                f"{self.path}: its rounds' reports hold a camera that is none ({error}); run "
                "reconstruct again"
            ) from None

    def lacking(self) -> str | None:
        """Why the project's own pictures cannot be shown; None when they can."""
        return self._frames.lacking()

    def _run_view(
        self,
        whole: SpatialMemory,
        reports: tuple[Mapping[str, Any], ...] = (),
        *,
        planned: int | None = None,
    ) -> RunView:
        memory = whole.overview()

        def page(run: RunView, most: int) -> SharedPage:
            source = ExportSource(self.path, memory)
            fit = source.appearance
            options = ExportOptions(max_points=most + (0 if fit is None else len(fit.gaussians)))
            return page_of(run, source.splats(options, exposed=False), fit=fit)

        return RunView(
            self.path, memory, reports, cameras_of(memory, reports), self._frames, planned,
            (POINTS, SPLATS, RENDERED), page,
        )  # fmt: skip


class ProjectFrames:
    """A project's pixels by a view's name, None where there are none; opened when first asked."""

    def __init__(self, run: Run | None) -> None:
        self.run = run
        self._lock = threading.Lock()
        # Looking at a camera again, or at another colour of it, is common; a scan would not fit.
        self._load = lru_cache(maxsize=KEPT_FRAMES)(self._load_frame)

    def __call__(self, name: str) -> Frame | None:
        """The pixels of a view; None where the project has none or they cannot be read."""
        return self._load(name)

    def lacking(self) -> str | None:
        """Why there are none at all; None when there are."""
        with self._lock:
            return self._opened[1]

    @cached_property
    def _opened(self) -> tuple[tuple[Scene | None, Scene | None], str | None]:
        """The project and the targets' truths, and why there are none."""
        if self.run is None:
            return (None, None), "a memory without a run: no pictures of its cameras"
        try:
            return self.run.scenes, None
        except (GvError, KeyError, TypeError) as error:
            return (None, None), f"no pictures of the project: {error}"

    def _load_frame(self, name: str) -> Frame | None:
        with self._lock:
            scene, truths = self._opened[0]
        if self.run is None or name not in self.run.context:
            scene = truths
        if scene is None or name not in scene.names:
            return None
        try:
            return scene[name].load()
        except GvError:
            return None


def open_file(path: Path) -> RunView | None:
    """What a file shows; None where it is no export but, perhaps, a memory or a run."""
    if path.is_dir() and holds_splats(path):
        return _open_splats(path)
    suffix = path.suffix.lower()
    if path.is_file() and suffix not in ("", ".npz", *OPENERS):
        raise OptionError(
            f"{path}: files that end with {suffix} are not opened; expected a run's folder, or "
            f"{', '.join(('.npz', *OPENERS))}"
        )
    if not path.is_file() or suffix not in OPENERS:
        return None
    try:
        return OPENERS[suffix](path)
    except GvError:
        raise
    except Exception as error:  # Readers of other packages raise what they please.
        raise MemoryFileError(
            f"{path}: cannot be read as {suffix} ({type(error).__name__}); expected a file as "
            "gvtools export writes it; export it again"
        ) from error


def _open_ply(path: Path) -> RunView | None:
    if read_header(path).holds("face"):
        return _open_mesh(path)
    return _open_splats(path) if holds_splats(path) else None


def _open_mesh(path: Path) -> RunView:
    require("trimesh", extra="export", purpose=f"{path}: {path.suffix}")
    import trimesh

    loaded = load_mesh(path)
    if isinstance(loaded, trimesh.PointCloud):
        colors = np.asarray(loaded.colors)[:, :3] if len(loaded.colors) else None
        return RunView(path, _memory(path, loaded.vertices, colors), told_up=told_up(path))
    vertices, colors = np.asarray(loaded.vertices, np.float64), _vertex_colors(loaded)
    mesh = ColoredMesh(vertices, np.asarray(loaded.faces), colors)
    return RunView(
        path, _memory(path, vertices, colors), looks=(MESH, POINTS), surface=mesh,
        told_up=told_up(path),
    )  # fmt: skip


def _vertex_colors(mesh: trimesh.Trimesh) -> NDArray[np.uint8]:
    """(V, 3) of any mesh; of a texture, those at the vertices."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        visual = visual.to_color()
    if visual.kind is None:
        return np.full((len(mesh.vertices), 3), GREY, np.uint8)
    return np.asarray(visual.vertex_colors, np.uint8)[:, :3]


def _open_las(path: Path) -> RunView:
    from gvtools.scans.read import read_scan

    require("laspy", extra="export", purpose=f"{path}: {path.suffix}")
    scan = read_scan(path, generated=True)
    return RunView(path, _memory(path, scan.positions + scan.origin, scan.colors))


def _open_usd(path: Path) -> RunView:
    try:
        return _open_splats(path)
    except MemoryFileError:
        positions, colors, up = read_usd(path)
        return RunView(path, _memory(path, positions, colors), told_up=up)


def _open_splats(path: Path) -> RunView:
    splats = read_splats(path)
    colors = np.rint(255 * splats.colors).astype(np.uint8)
    size = float(np.exp(np.median(splats.values[:, LOG_SCALE:QUATERNION])))
    memory = _memory(path, splats.positions + splats.origin, colors, edge=size)
    return RunView(
        path, memory, looks=(SPLATS, POINTS), page_of=lambda run, _: page_of(run, splats),
        told_up=splats.up,
    )  # fmt: skip


def _memory(
    path: Path, positions: NDArray[Any], colors: NDArray[Any] | None, *, edge: float = 1.0
) -> SpatialMemory:
    """A memory of a file's points; ``edge`` is that of its voxel where all lie at one place."""
    from gvtools.o3d import o3d

    cloud = o3d.t.geometry.PointCloud()
    if colors is None:
        colors = np.full((len(positions), 3), GREY, np.uint8)
    cloud.point.positions = o3d.core.Tensor(np.ascontiguousarray(positions, np.float64))
    cloud.point.colors = o3d.core.Tensor(np.ascontiguousarray(colors, np.uint8))
    try:
        apart = not (positions == positions[:1]).all()
        return SpatialMemory.from_point_cloud(cloud, voxel=None if apart else edge, name=path.name)
    except GvError as error:
        raise MemoryFileError(f"{path}: {error}") from None


OPENERS: Mapping[str, Callable[[Path], RunView | None]] = {
    **dict.fromkeys(READERS, _open_splats),
    ".ply": _open_ply,
    **dict.fromkeys(
        GLTF_ENDS, lambda path: _open_splats(path) if holds_splats(path) else _open_mesh(path)
    ),
    ".obj": _open_mesh,
    **dict.fromkeys((".las", ".laz"), _open_las),
    **dict.fromkeys(USD_ENDS, _open_usd),
}
