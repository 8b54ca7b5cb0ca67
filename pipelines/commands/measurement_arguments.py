"""The options of commands that measure pictures: which figures, and by what."""

from __future__ import annotations

import argparse
from pathlib import Path

MATCHERS = ("sift", "lightglue")


def add_measurement_arguments(parser: argparse.ArgumentParser) -> None:
    """``--json``, ``--parts``, ``--no-control`` and ``--matcher``."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    parser.add_argument(
        "--parts",
        default="images,consistency,poses",
        metavar="NAMES",
        help="what to measure (default %(default)s)",
    )
    parser.add_argument(
        "--no-control",
        action="store_true",
        help="leave out the same measures on the true pictures, which tell how to read the figures",
    )
    parser.add_argument(
        "--matcher", choices=MATCHERS, default="sift", help="of the pose probe (default sift)"
    )
