"""``gvtools report``: a run as one HTML page that needs neither network nor other files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "write a run's report: one HTML page with plots, pictures, figures and settings"
EXAMPLES = (
    "gvtools report runs/kitchen",
    "gvtools report runs/kitchen --pictures 30 --out kitchen.html",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("run", type=Path, metavar="RUN", help="a run's folder, finished or not")
    parser.add_argument("--out", type=Path, metavar="FILE", help="default RUN/report.html")
    parser.add_argument(
        "--pictures",
        type=int,
        default=12,
        metavar="N",
        help="targets whose pictures are shown, at most (%(default)s)",
    )
    parser.add_argument(
        "--project", type=Path, metavar="DIR", help="where the run's project lies, if it was moved"
    )


def run(args: argparse.Namespace, console: Console) -> None:
    """Write the page."""
    from gvtools.files import write_text
    from pipelines.report import PAGE, collect
    from viz.report.page import report_html

    if args.pictures < 1:
        raise OptionError(f"--pictures {args.pictures}; expected at least 1")
    out = args.out or args.run / PAGE
    _refuse_foreign(out)
    report = collect(args.run, project=args.project, most=args.pictures)
    page = report_html(report)
    write_text(out, page)
    for warning in report.warnings:
        console.warn(warning)
    shown = len(report.sheets.rows)
    console.line(f"{out}: {len(page) / 2**20:.1f} MiB, {shown} targets with pictures")


def _refuse_foreign(out: Path) -> None:
    """Keep what no report is."""
    if out.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"--out {out}: expected a name that ends with .html")
    if out.is_dir():
        raise OptionError(f"--out {out}: is a folder; expected a file's name")
