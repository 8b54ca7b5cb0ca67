"""``gvtools view``, ``report`` and ``plot``: runs to look at."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from gvtools.errors import OptionError, ProjectError
from gvtools.files import replaced_when_written, write_text
from pipelines.options import Arguments, check_ending

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pipelines.console import Console


class ViewCommand(Arguments):
    """Look at a run or an exported file: web page, Open3D window or picture."""

    examples = (
        "gvtools view runs/kitchen",
        "gvtools view runs/kitchen --screenshot kitchen.png --color source",
        "gvtools view kitchen.spz",
    )
    positional = ("folder",)
    exclusive = (("web", "open3d", "screenshot"),)

    folder: Path
    """A run, memory.npz, or a file of gvtools export: splats and points (.ply, .spz, .las, .laz,
    .usdc, .usda, .glb, .gltf), meshes (.ply, .glb, .gltf, .obj), recordings (.rrd, by rerun).
    [RUN_OR_FILE]"""
    web: bool = False
    """Serve a web page (default)."""
    open3d: bool = False
    """Open Open3D's window instead."""
    screenshot: Path | None = None
    """Write a PNG and end; needs no display. [FILE]"""
    live: bool = False
    """Follow a run that is at work, from before its start."""
    host: str = "127.0.0.1"
    """Address to serve at; the default is this machine alone."""
    port: int = Field(8080, ge=1, le=65535)
    """The first one tried."""
    max_points: int = Field(1_000_000, ge=1)
    """Draw at most so many points on the page, spread evenly. [N]"""
    color: Literal["color", "round", "source", "confidence", "views", "depth-error"] = "color"
    """What colours show."""
    round: int | None = None
    """Begin with it (default the last). [R]"""
    camera: str | None = None
    """The view that a picture is taken from. [NAME]"""
    project: Path | None = None
    """Where the run's project lies now, if moved. [PATH]"""

    def run(self, console: Console) -> None:
        from pipelines.viewing import serve as serving
        from pipelines.viewing.source import ViewSource

        if self.live:
            self.refuse(("open3d", "screenshot"), "the web page alone follows a run (--live)")
        if self.screenshot is not None:
            check_ending(self.screenshot, (".png",), option="--screenshot")
        if self.folder.suffix.lower() == serving.RECORDING:
            why = f"{self.folder}, a recording, opens in rerun's own viewer"
            self.refuse(("open3d", "screenshot"), why)
            serving.open_recording(self.folder, host=self.host, port=self.port)
            return
        source = ViewSource(self.folder, project=self.project)
        if self.live or not (self.open3d or self.screenshot):
            try:
                serving.serve(source, self, console)
            except KeyboardInterrupt:
                console.line("viewer ended")
            return
        if self.open3d and not serving.has_display():
            raise OptionError("--open3d: no display; expected X or Wayland; use --screenshot FILE")
        shown, number = serving.read_round(source, self.round)
        if self.screenshot is not None:
            from viz.viewer.render import chosen_camera, write_screenshot

            camera = chosen_camera(shown, self.camera)
            write_screenshot(self.screenshot, shown, camera, round=number, mode=self.color)
            console.line(f"{self.screenshot}: round {number} from {camera.name}")
        else:
            from viz.viewer.window import Open3dViewer

            viewer = Open3dViewer(shown, round=number, mode=self.color, say=console.line)
            viewer.run_until_closed()


class ReportCommand(Arguments):
    """Write a run's report: one HTML page with plots, pictures, figures and settings."""

    examples = (
        "gvtools report runs/kitchen",
        "gvtools report runs/kitchen --pictures 30 --out kitchen.html",
    )
    positional = ("folder",)

    folder: Path
    """A run's folder, finished or not. [RUN]"""
    out: Path | None = None
    """Default RUN/report.html. [FILE]"""
    pictures: int = Field(12, ge=1)
    """Targets whose pictures are shown, at most. [N]"""
    project: Path | None = None
    """Where the run's project lies, if it was moved. [DIR]"""

    def run(self, console: Console) -> None:
        from pipelines.report import PAGE, collect
        from viz.report.page import report_html

        out = self.out or self.folder / PAGE
        check_ending(out, (".html", ".htm"))
        report = collect(self.folder, project=self.project, most=self.pictures)
        page = report_html(report)
        write_text(out, page)
        for warning in report.warnings:
            console.warn(warning)
        shown = len(report.sheets.rows)
        console.line(f"{out}: {len(page) / 2**20:.1f} MiB, {shown} targets with pictures")


FORMATS = (".png", ".svg", ".pdf")
DPI = 150


class PlotCommand(Arguments):
    """Draw one figure of a run or a training."""

    examples = (
        "gvtools plot trajectories runs/kitchen --out kitchen.svg",
        "gvtools plot losses training/tiny --out losses.png",
    )
    positional = ("what", "folder")

    what: Literal["growth", "coverage", "timing", "trajectories", "frames", "losses"]
    """growth: of a run: what is stored, what became of the points, coverage, time; coverage: of a
    run: coverage against round; timing: of a run: time by stage and by round; trajectories: of a
    run: given, requested and estimated cameras; frames: of a run: two context views, then targets
    1, 3 and 5 of each round, and their photographs (the paper's figure); losses: of a training, or
    of one stage's folder: loss curves."""
    folder: Path
    """Of the run or training. [DIR]"""
    out: Path
    """Ends with .png, .svg or .pdf. [FILE]"""

    def run(self, console: Console) -> None:
        ending = check_ending(self.out, FORMATS)
        figure = _figure(self.what, self.folder)
        with replaced_when_written(self.out) as temporary:
            figure.savefig(temporary, format=ending[1:], dpi=DPI)
        console.line(f"{self.what} of {self.folder} in {self.out}")


def _figure(what: str, folder: Path) -> Figure:
    title = folder.resolve().name
    if what == "losses":
        from viz.plots.curves import draw_losses

        return draw_losses(read_training(folder), title=title)
    from pipelines.report import load_started

    run = load_started(folder)
    rounds = run.rounds
    if what == "trajectories":
        from pipelines.report import open_sources, read_measures, report_poses
        from viz.plots.trajectories import draw_trajectories

        sources = open_sources(run)
        probe = read_measures(run).poses
        poses = report_poses(rounds, sources.scene, run.context, probe=probe).cameras
        if poses is None:
            raise ProjectError(f"{folder}: no cameras to draw ({sources.problem or 'no targets'})")
        return draw_trajectories(poses, title=title)
    if what == "frames":
        from pipelines.report import frame_rows
        from viz.plots.frames import draw_frames

        return draw_frames(frame_rows(run), title=title)
    if what in ("growth", "coverage"):
        from viz.plots.rounds import draw_growth

        return draw_growth(rounds, title=title, panels=None if what == "growth" else [what])
    from viz.plots.rounds import draw_timing

    return draw_timing(rounds, title=title)


def read_training(folder: Path) -> dict[str, list[dict[str, object]]]:
    """The logs of a training's stages by name, or of the one stage whose folder it is."""
    from gvtools.training.records import STAGES, read_log

    logs = {stage: read_log(folder / stage) for stage in STAGES}
    logs = {stage: records for stage, records in logs.items() if records}
    if not logs:
        own = read_log(folder)
        logs = {folder.resolve().name: own} if own else {}
    if not logs:
        raise ProjectError(
            f"{folder}: holds no log.jsonl with a record, nor do {', '.join(STAGES)} in it; "
            "expected the folder of a training or of one of its stages"
        )
    return logs
