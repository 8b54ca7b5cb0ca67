"""gvtools merge: one run out of the runs of a project's blocks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "join the runs of a project's blocks into one run"
EXAMPLES = (
    "gvtools merge runs/block-* --out runs/city",
    "gvtools merge runs/block-* --out runs/city --blocks blocks --project city/",
)


class MergeArguments(Arguments):
    """The command's arguments."""

    positional = ("runs",)

    runs: tuple[Path, ...]
    """A block's finished run. [RUN]"""
    out: Path
    """The merged run. [RUN]"""
    blocks: Path | None = None
    """Where the split lies now, if it was moved. [FOLDER]"""
    project: Path | None = None
    """Where the whole project lies now, if moved. [DIR]"""
    resume: bool = False
    """Continue after the last whole round."""


def run(args: MergeArguments, console: Console) -> None:
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
