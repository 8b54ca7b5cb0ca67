"""``gvtools export``: a run or a memory for other tools, in the input's world frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.commands.arguments import EMPTY
from pipelines.export.formats import FORMATS, ExportFormat, ExportOptions, FormatName
from pipelines.options import Arguments

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipelines.console import Console

_FORMATS = "; ".join(
    f"{each.name}: {each.holds}" + (f" ({', '.join(each.suffixes)})" if each.suffixes else "")
    for each in FORMATS.values()
)


class ExportCommand(Arguments, ExportOptions):
    """Write a run as point cloud, splats, mesh, cameras or recording, in the input's frame."""

    examples = (
        "gvtools export runs/kitchen --format splat --out kitchen.ply",
        "gvtools export runs/kitchen --out kitchen.sog",
        "gvtools export runs/kitchen --format mesh --out kitchen.glb --max-triangles 200000",
        "gvtools export runs/kitchen --format las --out kitchen.laz --observed",
    )
    positional = ("memory",)

    memory: Path
    """A run, a memory.npz, or splats of any of their formats to convert. [RUN_OR_FILE]"""
    format: FormatName | None = Field(
        None, description=f"Default by the end of --out where one alone has it. {_FORMATS}"
    )
    out: Path
    """A file of the format; colmap: a folder, the model goes to its sparse/0; transforms: a folder
    or a .json file. [PATH]"""
    round: int | None = None
    """The memory as it was after round R. [R]"""

    def run(self, console: Console) -> None:
        from gvtools.runs.run import load_memory
        from gvtools.splat_files import holds_splats
        from pipelines.export.source import ExportSource

        splats = holds_splats(self.memory)
        converts = splats and self.out.suffix.lower() in FORMATS["splat"].suffixes
        form = FORMATS["splat"] if converts and self.format is None else self._form()
        for name in ExportOptions.model_fields:
            if name not in form.options:
                takers = ", ".join(each.name for each in FORMATS.values() if name in each.options)
                self.refuse((name,), f"--format {form.name} does not take it ({takers} do)")
        if self.out.suffix.lower() != ".spz":
            self.refuse(("spz_version",), f"--out {self.out} is no .spz")
        form.check_path(self.out, self.memory)
        if splats and form.name in ("splat", "spz", "html"):
            self._convert(console, form)
            return
        if splats:
            raise OptionError(
                f"--format {form.name}: {self.memory} holds Gaussians; expected a run or its "
                "memory; give --format splat, spz or html"
            )
        if form.name in ("colmap", "transforms", "mesh") and self.memory.suffix.lower() == ".ply":
            raise OptionError(
                f"--format {form.name}: {self.memory} is a PLY, which holds no cameras; give the "
                "run's folder or its memory.npz"
            )
        write = form.load()
        memory = load_memory(self.memory, up_to=self.round)
        if not len(memory):
            raise OptionError(f"{self.memory}: {EMPTY}")
        if form.name != "ply" or self.max_points is not None:
            shown = memory.overview()
            if len(shown) < len(memory):
                console.line(
                    f"{len(memory):,} observations exceed the memory's budget; {len(shown):,} "
                    "stand for them"
                )
            memory = shown
        source = ExportSource(self.memory, memory, self.round, self._told_up())
        console.line(write(source, self.out, self) + _said(source.up))
        made = memory.generated_count / len(memory)
        if made and "observed" in form.options and not self.observed:
            console.line(
                f"{made:.0%} of the observations are generated: a completer's, or depth that only "
                "fitted Gaussians tell; --observed leaves them out"
            )

    def _form(self) -> ExportFormat:
        """The format that is named, or that alone has the suffix."""
        if self.format is not None:
            return FORMATS[self.format]
        suffix = self.out.suffix.lower()
        fits = [each for each in FORMATS.values() if suffix in each.suffixes and each.name != "spz"]
        if self.out.name.lower().endswith(".compressed.ply"):
            fits = [FORMATS["splat"]]
        if len(fits) != 1:
            names = ", ".join(each.name for each in fits or FORMATS.values())
            ends = {end for each in FORMATS.values() for end in each.suffixes}
            known = "" if fits else f"; or an end that is written: {', '.join(sorted(ends))}"
            raise OptionError(f"--out {self.out}: give --format, one of {names}{known}")
        return fits[0]

    def _convert(self, console: Console, form: ExportFormat) -> None:
        """Splats of a file in another format."""
        from gvtools.splat_files import read_splats
        from pipelines.export.splats import write_file

        self.refuse(("max_points", "observed", "round"), f"{self.memory} is a file of splats")
        splats = read_splats(self.memory)
        splats = replace(splats, up=splats.up if self.up is None else self._told_up())
        said = _said(splats.up)
        if self.memory.suffix.lower() == ".spz":
            said += "; turned half around x, as an SPZ's axes are right, up, back"
        if form.name == "html":
            from pipelines.export.html import page_of, write_page
            from pipelines.viewing.source import ViewSource

            run = replace(ViewSource(self.memory).read(), told_up=splats.up)
            console.line(write_page(page_of(run, splats), splats, self.out) + said)
            return
        console.line(write_file(splats, self.out, self) + said)

    def _told_up(self) -> NDArray[np.float64] | None:
        """(3,) unit vector of --up."""
        if self.up is None:
            return None
        import numpy as np

        length = float(np.linalg.norm(self.up))
        if not 0 < length < np.inf:
            told = " ".join(f"{x:g}" for x in self.up)
            raise OptionError(f"--up {told}; expected three finite numbers, not all 0")
        return np.array(self.up) / length


def _said(up: NDArray[np.float64] | None) -> str:
    return "" if up is None else "; up is " + " ".join(f"{round(x, 3) + 0:g}" for x in up)
