"""``gvtools report``: a run as one HTML page that needs neither network nor other files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "write a run's report: one HTML page with plots, pictures, figures and settings"
EXAMPLES = (
    "gvtools report runs/kitchen",
    "gvtools report runs/kitchen --pictures 30 --out kitchen.html",
)


class ReportArguments(Arguments):
    """The command's arguments."""

    positional = ("run",)

    run: Path
    """A run's folder, finished or not. [RUN]"""
    out: Path | None = None
    """Default RUN/report.html. [FILE]"""
    pictures: int = Field(12, ge=1)
    """Targets whose pictures are shown, at most. [N]"""
    project: Path | None = None
    """Where the run's project lies, if it was moved. [DIR]"""


def run(args: ReportArguments, console: Console) -> None:
    """Write the page."""
    from gvtools.files import write_text
    from pipelines.report import PAGE, collect
    from viz.report.page import report_html

    out = args.out or args.run / PAGE
    if out.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"--out {out}: expected a name that ends with .html")
    if out.is_dir():
        raise OptionError(f"--out {out}: is a folder; expected a file's name")
    report = collect(args.run, project=args.project, most=args.pictures)
    page = report_html(report)
    write_text(out, page)
    for warning in report.warnings:
        console.warn(warning)
    shown = len(report.sheets.rows)
    console.line(f"{out}: {len(page) / 2**20:.1f} MiB, {shown} targets with pictures")
