"""The runs of a split project's blocks, as a merge reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gvtools.errors import OptionError, ProjectError
from gvtools.runs.poses import refined_poses_of
from gvtools.runs.run import Run, RunTarget, load_run
from pipelines.blocks.block import FILE, SceneBlock
from pipelines.blocks.write import by_name, read_blocks

# What may differ from block to block.
OF_A_BLOCK = ("context", "targets")


@dataclass(frozen=True, eq=False)
class BlockRun:
    """A finished run of a block.

    Attributes:
        run: the run.
        block: the block that it is of.
    """

    run: Run
    block: SceneBlock

    @cached_property
    def poses(self) -> dict[str, np.ndarray]:
        """(4, 4) cam_from_world that the run built its memory with, of each view of its own."""
        refined = refined_poses_of(self.run.path)
        if refined is None:
            return {name: self.block.poses[name] for name in self.block.owners}
        found = dict(zip(self.run.context, refined.context, strict=True))
        return {name: found[name] for name in self.block.owners}

    @property
    def held(self) -> dict[str, np.ndarray]:
        """(4, 4) cam_from_world of the views that the block holds out."""
        return {name: self.block.poses[name] for name in self.block.targets}

    @property
    def moved(self) -> bool:
        """Whether the run refined poses of its own."""
        return refined_poses_of(self.run.path) is not None

    def targets(self, *, held_out: bool) -> list[RunTarget]:
        """The run's targets that are the block's own.

        Args:
            held_out: those that the block holds; otherwise those of a path in its cell.
        """
        held = set(self.block.targets)
        if held_out != self.held_out:
            return []
        return [
            target
            for target in self.run.views
            if (target.name in held if held_out else self._inside(target))
        ]

    def _inside(self, target: RunTarget) -> bool:
        return bool(self.block.cell.holds(target.camera.centers).all())

    @property
    def held_out(self) -> bool:
        """Whether the targets are views of the project."""
        return bool(self.run.record["targets_kind"] == "hold-out")


def read_runs(paths: Sequence[Path], *, blocks: Path | None = None) -> list[BlockRun]:
    """The runs of all blocks of one split, in order of the blocks' names.

    Args:
        paths: their folders, in any order.
        blocks: where the split lies now; None: where it lay.
    """
    known = {} if blocks is None else {path.name: path for path, _ in read_blocks(blocks)}
    found: dict[str, BlockRun] = {}
    for path in paths:
        run = load_run(path)
        if not run.complete:
            raise ProjectError(
                f"{path}: {len(run.rounds)} of {run.planned} rounds; expected a finished run; "
                "reconstruct with --resume"
            )
        place = Path(run.record["project"])
        place = known.get(place.name, place) if blocks else place
        if not (place / FILE).is_file():
            raise ProjectError(
                f"{path}: its project {place} is no block, or is gone; expected one that gvtools "
                "split wrote; say by --blocks where the split lies"
            )
        block = SceneBlock.load(place)
        if block.name in found:
            raise OptionError(
                f"{found[block.name].run.path} and {path} are both of block {block.name}; expected "
                "one run of each block"
            )
        missing = sorted(set(block.owners) - set(run.context))
        if missing:
            raise ProjectError(
                f"{path}: its context lacks {missing[0]} and {len(missing) - 1} more of block "
                f"{block.name}; expected --context @{place}/context.txt"
            )
        found[block.name] = BlockRun(run, block)
    order = by_name({name: item.block for name, item in found.items()}, what="the given runs")
    runs = [found[block.name] for block in order]
    _check_alike(runs)
    return runs


def _check_alike(runs: Sequence[BlockRun]) -> None:
    first = _shared(runs[0].run.record["settings"])
    for item in runs[1:]:
        other = _shared(item.run.record["settings"])
        different = sorted(key for key in {*first, *other} if first.get(key) != other.get(key))
        if different:
            raise OptionError(
                f"{item.run.path} and {runs[0].run.path} differ in {', '.join(different)}; "
                "expected runs of the same settings"
            )
    if first.get("protocol") == "paper" or first["fusion"]["generated_as_observed"]:
        raise OptionError(
            f"{runs[0].run.path}: its generated points count as observed ones (protocol paper); "
            "expected them apart, since a merge observes again; reconstruct without"
        )


def _shared(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key not in OF_A_BLOCK}
