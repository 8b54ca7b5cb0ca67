"""``gvtools export``: a run or a memory for other tools, in the input's world frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.commands.arguments import EMPTY
from pipelines.export.formats import FORMATS, ExportOptions, FormatName
from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console

_FORMATS = "; ".join(
    f"{each.name}: {each.holds}" + (f" ({', '.join(each.suffixes)})" if each.suffixes else "")
    for each in FORMATS.values()
)


class ExportCommand(Arguments, ExportOptions):
    """Write a run as point cloud, splats, mesh, cameras or recording, in the input's frame."""

    examples = (
        "gvtools export runs/kitchen --format splat --out kitchen.ply",
        "gvtools export runs/kitchen --format mesh --out kitchen.glb --max-triangles 200000",
        "gvtools export runs/kitchen --format las --out kitchen.laz --observed",
    )
    positional = ("memory",)

    memory: Path
    """A run or a memory.npz. [RUN_OR_MEMORY]"""
    format: FormatName = Field(description=_FORMATS)
    out: Path
    """A file of the format; colmap: a folder, the model goes to its sparse/0; transforms: a folder
    or a .json file. [PATH]"""
    round: int | None = None
    """The memory as it was after round R. [R]"""

    def run(self, console: Console) -> None:
        from gvtools.runs.run import load_memory
        from pipelines.export.source import ExportSource

        form = FORMATS[self.format]
        for name in (name for name in ExportOptions.model_fields if name in self.model_fields_set):
            if name not in form.options:
                takers = ", ".join(each.name for each in FORMATS.values() if name in each.options)
                raise OptionError(
                    f"{self.key(name)}: --format {form.name} does not take it ({takers} do); leave "
                    "it out"
                )
        if self.format in ("colmap", "transforms", "mesh") and self.memory.suffix.lower() == ".ply":
            raise OptionError(
                f"--format {self.format}: {self.memory} is a PLY, which holds no cameras; give the "
                "run's folder or its memory.npz"
            )
        form.check_path(self.out, self.memory)
        write = form.load()
        memory = load_memory(self.memory, up_to=self.round)
        if not len(memory):
            raise OptionError(f"{self.memory}: {EMPTY}")
        if self.format != "ply" or self.max_points is not None:
            shown = memory.overview()
            if len(shown) < len(memory):
                console.line(
                    f"{len(memory):,} observations exceed the memory's budget; {len(shown):,} "
                    "stand for them"
                )
            memory = shown
        console.line(write(ExportSource(self.memory, memory, self.round), self.out, self))
        made = memory.generated_count / len(memory)
        if made and "observed" in form.options and not self.observed:
            console.line(
                f"{made:.0%} of the observations are generated: a completer's, or depth that only "
                "fitted Gaussians tell; --observed leaves them out"
            )
