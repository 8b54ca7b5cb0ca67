"""gvtools split: cut a project into blocks that are reconstructed each by itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gvtools.errors import OptionError
from pipelines.commands.arguments import SceneArguments

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "cut a project into overlapping blocks, each a project of its own"
EXAMPLES = (
    "gvtools split city/ --blocks 16 --out blocks",
    "gvtools split scan/ --blocks 4 --context not:every:10 --layout chunks --out blocks",
)


class SplitArguments(SceneArguments):
    """The command's arguments."""

    positional = ("project",)

    project: Path
    """COLMAP, posed RGB-D, transforms.json or spec:NAME:SCENE. [PROJECT]"""
    out: Path
    """For the blocks. [FOLDER]"""
    blocks: str = "auto"
    """How many (auto: 150 views a block). [N|auto]"""
    overlap: float = 0.8
    """0 to 1: a view joins every block whose part of space holds at least 1 - X of what it sees.
    [X]"""
    context: str = "all"
    """Views that are given; the others are listed as targets.txt. [SPEC]"""
    layout: Literal["projects", "chunks"] = "projects"
    """Projects: a COLMAP workspace a block; chunks: as Hierarchical-3DGS's."""
    keep_poses: bool = False
    """Do not refine the poses of RGB-D views, as --set refine.poses=false of a run."""
    max_side: int = 1600
    """At which they are refined: that of the runs (--profile fast has 480). [pixels]"""


def run(args: SplitArguments, console: Console) -> None:
    """Run ``gvtools split``."""
    from pipelines.blocks.split import block_folder, split

    if args.blocks != "auto" and not (args.blocks.isdecimal() and int(args.blocks)):
        raise OptionError(f"--blocks {args.blocks}; expected auto or a number from 1")
    blocks = split(
        args.open_scene(args.project),
        args.out,
        blocks=None if args.blocks == "auto" else int(args.blocks),
        overlap=args.overlap,
        context=args.context,
        layout=args.layout,
        refine_poses=not args.keep_poses,
        max_side=args.max_side,
        reading=args.reading(),
        say=console.line,
    )
    folder = block_folder(args.out, blocks[0].name, args.layout)
    targets = f" --targets @{folder}/targets.txt" if blocks[0].targets else ""
    console.line(
        f"{len(blocks)} blocks in {args.out}; reconstruct each, then merge the runs:\n"
        f"gvtools reconstruct {folder} --context @{folder}/context.txt{targets} --out RUN"
    )
