"""``gvtools bench``: our times beside those of what a user would otherwise call, as ratios.

``bench complete`` times the generative core by stage, which has no peer.
"""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.bench.options import CompleteOptions
from pipelines.machine import load_average
from pipelines.options import JsonArguments, add_settings

if TYPE_CHECKING:
    from pipelines.bench.side_by_side import Comparison
    from pipelines.console import Console


POINTS = {"fuse": 3_200_000, "splat": 4_000_000}
# Options of ``CompleteOptions`` that bear its fields' names; --repeat is of all benchmarks.
COMPLETE = {name: name for name in CompleteOptions.model_fields if name != "repeat"}


class BenchCommand(JsonArguments):
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
        report(self, rows, console, bench=self.what, points=points, load=load_average())


def _run_complete(args: BenchCommand, given: dict[str, Any], console: Console) -> None:
    from pipelines.bench import complete, memory, prediction

    chosen = CompleteOptions(repeat=args.repeat, **given)
    measure, show = complete.complete_figures, complete.show
    if chosen.memory:
        measure, show = memory.memory_figures, memory.show_memory
    elif chosen.predict:
        measure, show = prediction.prediction_figures, prediction.show_prediction
    figures = measure(chosen)
    if not args.write_json(figures):
        show(figures, console)
        return
    rows = sum(len(figures.get(part, ())) for part in ("results", "inference", "training"))
    console.line(f"{rows} rows written to {args.json_}")


def report(
    args: JsonArguments, rows: list[Comparison], console: Console, **conditions: object
) -> None:
    """A table, or the JSON object with the rows under ``results``."""
    results = [row.to_dict() for row in rows]
    if args.write_json({**conditions, "cpus": os.cpu_count(), "results": results}):
        console.line(f"{len(rows)} comparisons written to {args.json_}")
        return
    columns = ("name", "peer", "ours_s", "peer_s", "ratio", "ratio_of_minima")
    console.table(("what", *columns[1:]), [[row[key] for key in columns] for row in results])
    for row in rows:
        if row.note:
            console.line(f"{row.name}, {row.peer}: {row.note}")
