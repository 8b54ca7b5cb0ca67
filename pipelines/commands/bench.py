"""``gvtools bench``: our times beside those of what a user would otherwise call, as ratios.

``bench complete`` times the generative core by stage, which has no peer.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from gvtools.errors import OptionError
from gvtools.files import write_json
from pipelines.bench.options import CompleteOptions
from pipelines.machine import load_average
from pipelines.options import Arguments, add_settings

if TYPE_CHECKING:
    from pipelines.bench.side_by_side import Comparison
    from pipelines.console import Console


POINTS = {"fuse": 3_200_000, "splat": 4_000_000}
# Options of ``CompleteOptions`` that bear its fields' names; --repeat is of all benchmarks.
COMPLETE = {name: name for name in CompleteOptions.model_fields if name != "repeat"}


class BenchCommand(Arguments):
    """Time fusing or projecting against Open3D, as ratios; or the generative core, by stage."""

    examples = (
        "gvtools bench splat --repeat 15 --json splat.json",
        "gvtools bench complete --config base",
        "gvtools bench complete --config base --memory --card 24",
        "gvtools bench complete --config base --predict",
    )
    positional = ("what",)

    settings_of = COMPLETE

    settings: dict[str, Any] = Field(default_factory=dict)
    what: Literal["fuse", "splat", "complete"]
    """Fuse: one 640x480 frame into a memory; splat: the memory into a camera; complete: a pass of
    the geoverse completer's network."""
    points: int | None = Field(None, ge=1000)
    """Voxels of the memory to fuse into (3.2 million), or points of the largest one-pixel
    projection (4 million; a quarter of them is timed as well). [N]"""
    repeat: int = Field(9, ge=1)
    """Timed turns of each. [N]"""
    json_: Path | None = None
    """Write the figures there. [FILE]"""

    @classmethod
    def add(cls, parser: argparse.ArgumentParser) -> None:
        """Add the arguments, and the options of ``complete``."""
        super().add(parser)
        group = parser.add_argument_group("of complete alone")
        # Without a check, which loads torch.
        defaults = CompleteOptions.model_construct()
        add_settings(group, defaults, COMPLETE, metavars={"size": "HxW|N", "weights": "DIR"})

    def run(self, console: Console) -> None:
        given = self.settings
        if self.what == "complete":
            self.refuse(("points",), "of fuse and splat, not of complete")
            _run_complete(self, given, console)
            return
        if given:
            names = ", ".join(sorted(f"--{name.replace('_', '-')}" for name in given))
            raise OptionError(f"bench {self.what}: {names} given, which only complete knows")
        points = POINTS[self.what] if self.points is None else self.points
        from pipelines.bench.side_by_side import fuse_rows, splat_rows

        measure = fuse_rows if self.what == "fuse" else splat_rows
        rows = measure(points, repeat=self.repeat)
        report(rows, console, self.json_, bench=self.what, points=points, load=load_average())


def _run_complete(args: BenchCommand, given: dict[str, Any], console: Console) -> None:
    from pipelines.bench.complete import complete_figures, show

    chosen = CompleteOptions(repeat=args.repeat, **given)
    if chosen.memory:
        from pipelines.bench.memory import memory_figures, show_memory

        figures = memory_figures(chosen)
        rows = len(figures["inference"]) + len(figures["training"])
        tables = show_memory
    elif chosen.predict:
        from pipelines.bench.prediction import prediction_figures, show_prediction

        figures = prediction_figures(chosen)
        rows, tables = len(figures["results"]), show_prediction
    else:
        figures = complete_figures(chosen)
        rows, tables = len(figures["results"]), show
    if args.json_ is None:
        tables(figures, console)
        return

    write_json(args.json_, figures)
    console.line(f"{rows} rows written to {args.json_}")


def report(
    rows: list[Comparison], console: Console, path: Path | None, **conditions: object
) -> None:
    """A table, or the JSON object with the rows under ``results``."""
    results = [row.to_dict() for row in rows]
    if path is not None:
        import os

        write_json(path, {**conditions, "cpus": os.cpu_count(), "results": results})
        console.line(f"{len(rows)} comparisons written to {path}")
        return
    columns = ("name", "peer", "ours_s", "peer_s", "ratio", "ratio_of_minima")
    console.table(("what", *columns[1:]), [[row[key] for key in columns] for row in results])
    for row in rows:
        if row.note:
            console.line(f"{row.name}, {row.peer}: {row.note}")
