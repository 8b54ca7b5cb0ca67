"""gvtools split: cut a project into blocks that are reconstructed each by itself."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.commands.arguments import add_scene_arguments, open_scene, reading_of

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "cut a project into overlapping blocks, each a project of its own"
EXAMPLES = (
    "gvtools split city/ --blocks 16 --out blocks",
    "gvtools split scan/ --blocks 4 --context not:every:10 --layout chunks --out blocks",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "project", type=Path, help="COLMAP, posed RGB-D, transforms.json or spec:NAME:SCENE"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="for the blocks")
    parser.add_argument(
        "--blocks", default="auto", metavar="N|auto", help="how many (auto: 150 views a block)"
    )
    parser.add_argument(
        "--overlap",
        type=float,
        default=0.8,
        metavar="X",
        help="0 to 1: a view joins every block whose part of space holds at least 1 - X of what it "
        "sees (default 0.8)",
    )
    parser.add_argument(
        "--context",
        default="all",
        metavar="SPEC",
        help="views that are given (default all); the others are listed as targets.txt",
    )
    parser.add_argument(
        "--layout",
        choices=("projects", "chunks"),
        default="projects",
        help="projects: a COLMAP workspace a block (default); chunks: as Hierarchical-3DGS's",
    )
    parser.add_argument(
        "--keep-poses",
        action="store_true",
        help="do not refine the poses of RGB-D views, as --set refine.poses=false of a run",
    )
    parser.add_argument(
        "--max-side",
        type=int,
        default=1600,
        metavar="PIXELS",
        help="at which they are refined: that of the runs (default 1600; --profile fast has 480)",
    )
    add_scene_arguments(parser)


def run(args: argparse.Namespace, console: Console) -> None:
    """Run ``gvtools split``."""
    from gvtools.errors import OptionError
    from pipelines.blocks.split import block_folder, split

    number = None
    if args.blocks != "auto":
        if not (args.blocks.isdecimal() and int(args.blocks) > 0):
            raise OptionError(f"--blocks {args.blocks}; expected auto or a number from 1")
        number = int(args.blocks)
    blocks = split(
        open_scene(args.project, args),
        args.out,
        blocks=number,
        overlap=args.overlap,
        context=args.context,
        layout=args.layout,
        refine_poses=not args.keep_poses,
        max_side=args.max_side,
        reading=reading_of(args),
        say=console.line,
    )
    folder = block_folder(args.out, blocks[0].name, args.layout)
    targets = f" --targets @{folder}/targets.txt" if blocks[0].targets else ""
    console.line(
        f"{len(blocks)} blocks in {args.out}; reconstruct each, then merge the runs:\n"
        f"gvtools reconstruct {folder} --context @{folder}/context.txt{targets} --out RUN"
    )
