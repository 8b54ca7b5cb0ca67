"""The options by which a command is given LPIPS, and why it has none."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips


def add_lpips_arguments(parser: argparse.ArgumentParser) -> None:
    """Network and weights."""
    parser.add_argument(
        "--lpips-net", choices=("vgg", "alex"), default="vgg", help="below LPIPS (default vgg)"
    )
    parser.add_argument(
        "--lpips-weights",
        type=Path,
        metavar="DIR",
        help="the folder with the network's published weights (default: torch's cache)",
    )


def open_lpips(args: argparse.Namespace) -> tuple[Lpips | None, str | None]:
    """The network, or None with the reason."""
    from gvtools.errors import CheckpointError
    from gvtools.evaluation.lpips_distance import Lpips

    try:
        return Lpips(args.lpips_net, folder=args.lpips_weights), None
    except CheckpointError as error:
        if args.lpips_weights is not None:
            raise
        return None, str(error)
