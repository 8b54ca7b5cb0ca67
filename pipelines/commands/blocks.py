"""``gvtools split`` and ``merge``: blocks of a project, each reconstructed by itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.commands.arguments import SceneArguments
from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console


class SplitCommand(SceneArguments):
    """Cut a project into overlapping blocks, each a project of its own."""

    examples = (
        "gvtools split city/ --blocks 16 --out blocks",
        "gvtools split scan/ --blocks 4 --context not:every:10 --layout chunks --out blocks",
    )
    positional = ("project",)

    project: Path
    """COLMAP, posed RGB-D, transforms.json or spec:NAME:SCENE. [PROJECT]"""
    out: Path
    """For the blocks. [FOLDER]"""
    blocks: str = "auto"
    """How many (auto: 150 views a block). [N|auto]"""
    overlap: float = Field(0.8, ge=0, le=1)
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

    def run(self, console: Console) -> None:
        from pipelines.blocks.split import block_folder, split

        if self.blocks != "auto" and not (self.blocks.isdecimal() and int(self.blocks)):
            raise OptionError(f"--blocks {self.blocks}; expected auto or a number from 1")
        blocks = split(
            self.open_scene(self.project),
            self.out,
            blocks=None if self.blocks == "auto" else int(self.blocks),
            overlap=self.overlap,
            context=self.context,
            layout=self.layout,
            refine_poses=not self.keep_poses,
            max_side=self.max_side,
            reading=self.reading(),
            say=console.line,
        )
        folder = block_folder(self.out, blocks[0].name, self.layout)
        targets = f" --targets @{folder}/targets.txt" if blocks[0].targets else ""
        console.line(
            f"{len(blocks)} blocks in {self.out}; reconstruct each, then merge the runs:\n"
            f"gvtools reconstruct {folder} --context @{folder}/context.txt{targets} --out RUN"
        )


class MergeCommand(Arguments):
    """Join the runs of a project's blocks into one run."""

    examples = (
        "gvtools merge runs/block-* --out runs/city",
        "gvtools merge runs/block-* --out runs/city --blocks blocks --project city/",
    )
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

    def run(self, console: Console) -> None:
        from pipelines.blocks.merge import merge
        from pipelines.report import draw_run

        merge(
            self.runs,
            self.out,
            blocks=self.blocks,
            project=self.project,
            resume=self.resume,
            console=console,
            draw=draw_run,
        )
