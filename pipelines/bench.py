"""``gvtools bench``: our times beside those of what a user would otherwise call, as ratios."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from pipelines.console import Console
    from pipelines.side_by_side import Comparison

SUMMARY = "time fusing or projecting against Open3D in one process, as ratios"
EXAMPLES = ("gvtools bench fuse", "gvtools bench splat --repeat 15 --json splat.json")

FEWEST_POINTS = 1000
POINTS = {"fuse": 3_200_000, "splat": 4_000_000}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "what",
        choices=("fuse", "splat"),
        help="fuse: one 640x480 frame into a memory; splat: the memory into a camera",
    )
    parser.add_argument(
        "--points",
        type=int,
        metavar="N",
        help="voxels of the memory to fuse into (3.2 million), or points of the largest "
        "one-pixel projection (4 million; a quarter of them is timed as well)",
    )
    parser.add_argument(
        "--repeat", type=int, default=9, metavar="N", help="timed turns of each (%(default)s)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")


def run(args: argparse.Namespace, console: Console) -> None:
    """Run the benchmark and show or write its rows.

    Raises:
        OptionError: too few points or repeats.
    """
    points = POINTS[args.what] if args.points is None else args.points
    if points < FEWEST_POINTS or args.repeat < 1:
        raise OptionError(
            f"bench: {points} points, {args.repeat} repeats; expected at least {FEWEST_POINTS} "
            "points and 1 repeat"
        )
    import os

    if args.what == "fuse":
        from pipelines.bench_fuse import fuse_rows

        rows = fuse_rows(points, repeat=args.repeat)
    else:
        from pipelines.bench_splat import splat_rows

        rows = splat_rows(points, repeat=args.repeat)
    report(rows, console, args.json, bench=args.what, points=points, load=os.getloadavg()[0])


def report(
    rows: list[Comparison], console: Console, path: Path | None, **conditions: object
) -> None:
    """A table, or the JSON object with the rows under ``results``."""
    if path is not None:
        import os

        from pipelines.console import write_json

        data = {**conditions, "cpus": os.cpu_count(), "results": [row.to_dict() for row in rows]}
        write_json(path, data)
        console.line(f"{len(rows)} comparisons written to {path}")
        return
    console.table(
        ("what", "peer", "ours_s", "peer_s", "ratio", "ratio_of_minima"),
        [
            (row.name, row.peer, row.ours_s, row.peer_s, row.ratio, row.ratio_of_minima)
            for row in rows
        ],
    )
    for row in rows:
        if row.note:
            console.line(f"{row.name}, {row.peer}: {row.note}")
