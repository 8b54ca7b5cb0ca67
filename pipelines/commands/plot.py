"""``gvtools plot``: one figure of a run, a sweep or a training, as PNG, SVG or PDF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gvtools.errors import OptionError, ProjectError
from pipelines.options import Arguments

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pipelines.console import Console

SUMMARY = "draw one figure of a run or a training"
EXAMPLES = (
    "gvtools plot trajectories runs/kitchen --out kitchen.svg",
    "gvtools plot losses training/tiny --out losses.png",
)
FORMATS = ("png", "svg", "pdf")
DPI = 150


class PlotArguments(Arguments):
    """The command's arguments."""

    positional = ("what", "folder")

    what: Literal["growth", "coverage", "timing", "trajectories", "losses"]
    """growth: of a run: what is stored, what became of the points, coverage, time; coverage: of a
    run: coverage against round; timing: of a run: time by stage and by round; trajectories: of a
    run: given, requested and estimated cameras; losses: of a training, or of one stage's folder:
    loss curves."""
    folder: Path
    """Of the run or training. [DIR]"""
    out: Path
    """Ends with .png, .svg or .pdf. [FILE]"""


def run(args: PlotArguments, console: Console) -> None:
    """Draw and write."""
    from gvtools.files import replaced_when_written

    ending = args.out.suffix.lower().lstrip(".")
    if ending not in FORMATS:
        raise OptionError(f"--out {args.out}: expected a name that ends with .png, .svg or .pdf")
    figure = _figure(args.what, args.folder)
    with replaced_when_written(args.out) as temporary:
        figure.savefig(temporary, format=ending, dpi=DPI)
    console.line(f"{args.what} of {args.folder} in {args.out}")


def _figure(what: str, folder: Path) -> Figure:
    title = folder.resolve().name
    if what == "losses":
        from viz.plots.losses import draw_losses

        return draw_losses(read_training(folder), title=title)
    from gvtools.runs.run import load_run

    run = load_run(folder)
    rounds = run.rounds
    if what == "trajectories":
        from pipelines.report import open_sources, read_measures, report_poses
        from viz.plots.trajectories import draw_trajectories

        sources = open_sources(run)
        probe = read_measures(run).poses
        poses = report_poses(rounds, sources.scene, run.context, probe=probe).cameras
        if poses is None:
            raise ProjectError(f"{folder}: no cameras to draw ({sources.problem or 'no rounds'})")
        return draw_trajectories(poses, title=title)
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
