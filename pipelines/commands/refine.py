"""gvtools refine: fit a run's Gaussians further, and make the run again with them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "fit a run's Gaussians further, and make the run again with them"
EXAMPLES = ("gvtools refine runs/kitchen --seconds 600", "gvtools refine runs/kitchen --steps 2000")


class RefineArguments(Arguments):
    """The command's arguments."""

    positional = ("run",)
    exclusive = (("seconds", "steps"),)

    run: Path
    """A run's folder, finished or not. [RUN]"""
    seconds: float = Field(120.0, gt=0)
    """Fit so long. [S]"""
    steps: int | None = Field(None, ge=1)
    """So many steps, with the same result every time. [N]"""
    project: Path | None = None
    """Where the run's project lies, if it was moved. [DIR]"""


def run(args: RefineArguments, console: Console) -> None:
    """Run ``gvtools refine``."""
    from pipelines.reconstruction.run import refine
    from pipelines.report import draw_run

    refine(
        args.run,
        seconds=args.seconds if args.steps is None else None,
        steps=args.steps,
        project=args.project,
        console=console,
        draw=draw_run,
    )
