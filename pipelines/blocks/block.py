"""Blocks of a split project and their cells: ``block.json`` in a block's folder.

A block owns the views whose cameras stand in its cell, and holds others as helpers: they belong to
another block, but see what this one's views see. Cells are boxes, closed below and open above, that
fill all of space without overlap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from gvtools.errors import ProjectError
from gvtools.files import write_json
from gvtools.untrusted import read_json

FILE = "block.json"
FORMAT, VERSION = "gvtools block", 1
Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BlockCell:
    """A box of space, world frame, scene units; infinite where no other cell borders on it.

    >>> left, right = BlockCell.everywhere().cut(0, 1.5)
    >>> left.holds([[0, 9, 9], [1.5, 0, 0]]).tolist(), right.holds([[1.5, 0, 0]]).tolist()
    ([True, False], [True])
    """

    low: Float64
    high: Float64

    @classmethod
    def everywhere(cls) -> BlockCell:
        """All of space."""
        return cls(np.full(3, -np.inf), np.full(3, np.inf))

    def cut(self, axis: int, place: float) -> tuple[BlockCell, BlockCell]:
        """The parts below and from ``place`` on along an axis."""
        high, low = self.high.copy(), self.low.copy()
        high[axis] = low[axis] = place
        return BlockCell(self.low, high), BlockCell(low, self.high)

    def holds(self, points: Any) -> NDArray[np.bool_]:
        """(N,) which points (N, 3) lie in it."""
        points = np.asarray(points, np.float64)
        return ((points >= self.low) & (points < self.high)).all(axis=1)


@dataclass(frozen=True, eq=False)
class SceneBlock:
    """One block of a split project."""

    name: str  # also of its folder
    names: tuple[str, ...]  # of all blocks of the split
    project: str  # what opens the whole project
    reading: Mapping[str, Any]  # how that is read, JSON-ready
    cell: BlockCell
    owners: tuple[str, ...]  # context views in the cell, in order of their names
    helpers: tuple[str, ...]  # context views of other cells
    targets: tuple[str, ...]  # held-out views in the cell
    # (4, 4) cam_from_world of each owner and target, exactly as the blocks have them.
    poses: Mapping[str, Float64]
    refined: bool  # whether these poses are other ones than the project's

    @property
    def context(self) -> tuple[str, ...]:
        """Owners and helpers, in order of their names."""
        return tuple(sorted((*self.owners, *self.helpers)))

    def save(self, folder: Path) -> None:
        """Write ``block.json`` into the block's folder."""
        # JSON has no infinity; ``write_json`` makes it null.
        write_json(
            folder / FILE,
            {
                "format": FORMAT,
                "version": VERSION,
                "name": self.name,
                "names": list(self.names),
                "project": self.project,
                "reading": dict(self.reading),
                "low": self.cell.low.tolist(),
                "high": self.cell.high.tolist(),
                "owners": list(self.owners),
                "helpers": list(self.helpers),
                "targets": list(self.targets),
                "poses": {name: pose.tolist() for name, pose in self.poses.items()},
                "refined": self.refined,
            },
        )

    @classmethod
    def load(cls, folder: Path) -> SceneBlock:
        """Read what ``save`` wrote."""
        path = folder / FILE
        try:
            kept = _File.model_validate(read_json(path))
            poses = {name: np.array(pose, np.float64) for name, pose in kept.poses.items()}
            if any(pose.shape != (4, 4) or not np.isfinite(pose).all() for pose in poses.values()):
                raise ValueError("a pose is no 4x4 matrix of numbers")
            missing = {*kept.owners, *kept.targets} - poses.keys()
            if missing:
                raise ValueError(f"no pose of {min(missing)}")
        except FileNotFoundError:
            raise ProjectError(
                f"{folder}: no {FILE}; expected a block that gvtools split wrote"
            ) from None
        except (OSError, ValueError, ValidationError) as error:
            reason = " ".join(str(error).split())
            raise ProjectError(
                f"{path}: no block of this version ({reason[:200]}); split the project again"
            ) from None
        low = np.array([-np.inf if value is None else value for value in kept.low])
        high = np.array([np.inf if value is None else value for value in kept.high])
        return cls(
            kept.name, tuple(kept.names), kept.project, kept.reading, BlockCell(low, high),
            tuple(kept.owners), tuple(kept.helpers), tuple(kept.targets), poses, kept.refined,
        )  # fmt: skip


class _File(BaseModel):
    """``block.json``."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["gvtools block"]
    version: Literal[1]
    name: str
    names: list[str]
    project: str
    reading: dict[str, Any]
    low: tuple[float | None, float | None, float | None]
    high: tuple[float | None, float | None, float | None]
    owners: list[str]
    helpers: list[str]
    targets: list[str]
    poses: dict[str, list[list[float]]]
    refined: bool
