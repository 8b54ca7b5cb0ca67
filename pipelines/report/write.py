"""The pictures and the page of a run, written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.files import replaced_when_written, write_text
from pipelines.report.data import Sources, collect
from viz.report.page import report_html

if TYPE_CHECKING:
    from gvtools.runs.folder import RunDirectory
    from pipelines.reconstruction.plan import Plan

PAGE, GROWTH = "report.html", "growth.png"


def draw_run(plan: Plan, directory: RunDirectory) -> tuple[str, ...]:
    """The growth figure and the report of a finished run whose project is open.

    Args:
        plan: of the run.
        directory: its folder, with the figures in it.

    Returns:
        The names of the files.
    """
    from viz.plots.growth import draw_growth

    figure = draw_growth(directory.reports(), title=plan.scene.root.name)
    with replaced_when_written(directory.path / GROWTH) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    write_report(plan, directory.path)
    return PAGE, GROWTH


def write_report(plan: Plan, path: Path) -> None:
    """The report of a run whose project is open.

    Args:
        plan: of the run.
        path: its folder.
    """
    targets = plan.targets
    truths = dict(zip(targets.cameras.names, targets.truth, strict=True))
    write_text(path / PAGE, report_html(collect(path, sources=Sources(plan.scene, truths))))
