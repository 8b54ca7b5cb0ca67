"""gvtools refine: fit a run's Gaussians further, and make the run again with them."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "fit a run's Gaussians further, and make the run again with them"
EXAMPLES = ("gvtools refine runs/kitchen --seconds 600", "gvtools refine runs/kitchen --steps 2000")
SECONDS = 120.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("run", type=Path, metavar="RUN", help="a run's folder, finished or not")
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument(
        "--seconds", type=float, metavar="S", help=f"fit so long (default {SECONDS:.0f})"
    )
    amount.add_argument(
        "--steps", type=int, metavar="N", help="so many steps, with the same result every time"
    )
    parser.add_argument(
        "--project", type=Path, metavar="DIR", help="where the run's project lies, if it was moved"
    )


def run(args: argparse.Namespace, console: Console) -> None:
    """Run ``gvtools refine``."""
    from pipelines.reconstruction.run import refine
    from pipelines.report import draw_run

    if args.steps is not None and args.steps < 1:
        raise OptionError(f"--steps {args.steps}; expected at least 1")
    if args.seconds is not None and not 0 < args.seconds < math.inf:
        raise OptionError(f"--seconds {args.seconds:g}; expected a number above 0")
    seconds = (args.seconds or SECONDS) if args.steps is None else None
    refine(
        args.run,
        seconds=seconds,
        steps=args.steps,
        project=args.project,
        console=console,
        draw=draw_run,
    )
