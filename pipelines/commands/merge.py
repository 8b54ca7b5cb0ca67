"""gvtools merge: one run out of the runs of a project's blocks."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "join the runs of a project's blocks into one run"
EXAMPLES = (
    "gvtools merge runs/block-* --out runs/city",
    "gvtools merge runs/block-* --out runs/city --blocks blocks --project city/",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="a block's finished run")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="the merged run")
    parser.add_argument(
        "--blocks", type=Path, metavar="FOLDER", help="where the split lies now, if it was moved"
    )
    parser.add_argument(
        "--project", type=Path, metavar="DIR", help="where the whole project lies now, if moved"
    )
    parser.add_argument("--resume", action="store_true", help="continue after the last whole round")


def run(args: argparse.Namespace, console: Console) -> None:
    """Run ``gvtools merge``."""
    from pipelines.blocks.merge import merge
    from pipelines.report import draw_run

    merge(
        args.runs,
        args.out,
        blocks=args.blocks,
        project=args.project,
        resume=args.resume,
        console=console,
        draw=draw_run,
    )
