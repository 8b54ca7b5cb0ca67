"""Blocks of a split project: the cells that it is cut into, and the views of each.

A block (``block.json`` in its folder) owns the views whose cameras stand in its cell, and holds
others as helpers: they belong to another block, but see what this one's views see. Cells are boxes,
closed below and open above, that fill all of space without overlap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer

from gvtools.errors import OptionError, ProjectError
from gvtools.files import write_json
from gvtools.untrusted import read_json

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene


FILE = "block.json"
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


def _corner(value: Any, *, open_at: float) -> Float64:
    """(3,) of what JSON has, which knows no infinity."""
    return np.array([open_at if each is None else each for each in value], np.float64)


def _pose(value: Any) -> Float64:
    pose = np.array(value, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("a pose is no 4x4 matrix of numbers")
    return pose


_AS_LISTS = PlainSerializer(lambda array: array.tolist())
_Low = Annotated[Float64, BeforeValidator(partial(_corner, open_at=-np.inf)), _AS_LISTS]
_High = Annotated[Float64, BeforeValidator(partial(_corner, open_at=np.inf)), _AS_LISTS]
_Pose = Annotated[Float64, BeforeValidator(_pose), _AS_LISTS]


class SceneBlock(BaseModel):
    """One block of a split project, as ``block.json`` has it."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    format: Literal["gvtools block"] = "gvtools block"
    version: Literal[1] = 1
    name: str  # also of its folder
    names: tuple[str, ...]  # of all blocks of the split
    project: str  # what opens the whole project
    reading: dict[str, Any]  # how that is read, JSON-ready
    low: _Low  # corners of its cell
    high: _High
    owners: tuple[str, ...]  # context views in the cell, in order of their names
    helpers: tuple[str, ...]  # context views of other cells
    targets: tuple[str, ...]  # held-out views in the cell
    # (4, 4) cam_from_world of each owner and target, exactly as the blocks have them.
    poses: dict[str, _Pose]
    refined: bool  # whether these poses are other ones than the project's

    @property
    def cell(self) -> BlockCell:
        """The part of space that it owns."""
        return BlockCell(self.low, self.high)

    @property
    def context(self) -> tuple[str, ...]:
        """Owners and helpers, in order of their names."""
        return tuple(sorted((*self.owners, *self.helpers)))

    def save(self, folder: Path) -> None:
        """Write ``block.json`` into the block's folder."""
        write_json(folder / FILE, self.model_dump())

    @classmethod
    def load(cls, folder: Path) -> SceneBlock:
        """Read what ``save`` wrote."""
        path = folder / FILE
        try:
            block = cls.model_validate(read_json(path))
            missing = {*block.owners, *block.targets} - block.poses.keys()
            if missing:
                raise ValueError(f"no pose of {min(missing)}")
        except FileNotFoundError:
            raise ProjectError(
                f"{folder}: no {FILE}; expected a block that gvtools split wrote"
            ) from None
        except (OSError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ProjectError(
                f"{path}: no block of this version ({reason[:200]}); split the project again"
            ) from None
        return block


# Context views for each block if the number of blocks is not given.
VIEWS_PER_BLOCK = 150
# About so many points are sampled of what a view sees.
SAMPLES = 400
# So many nearest views of each of a block's own are helpers, whatever they see: stereo needs them.
NEAREST = 4


def cut_cells(centers: Float64, count: int) -> dict[str, BlockCell]:
    """Cells with about as many camera centres each, by name.

    An axis-parallel plane across the longest side of the centres' box divides them in two, then
    each part is divided in the same way, as in Hierarchical-3DGS. A name such as "0_1" encodes the
    path to the cell in this binary tree: the first half of its bits as a number, and the second.

    >>> places = np.array([[0, 0, 0], [1, 0, 0], [5, 0, 0], [5, 1, 0]], float)
    >>> {name: cell.holds(places).tolist() for name, cell in cut_cells(places, 2).items()}
    {'0_0': [True, True, False, False], '1_0': [False, False, True, True]}
    """
    if not 1 <= count <= len(centers):
        raise OptionError(
            f"{count} blocks of {len(centers)} context views; expected 1 to {len(centers)}"
        )
    leaves = _halved(centers, BlockCell.everywhere(), count, path="")
    half = (max(len(path) for path, _ in leaves) + 1) // 2
    return {
        f"{int(path[:half] or '0', 2)}_{int(path[half:] or '0', 2)}": cell
        for path, cell in ((path.ljust(2 * half, "0"), cell) for path, cell in leaves)
    }


def _halved(
    centers: Float64, cell: BlockCell, count: int, *, path: str
) -> list[tuple[str, BlockCell]]:
    """Divide a cell into ``count`` cells; returns each with its path, "0" low and "1" high."""
    if count == 1:
        return [(path, cell)]
    inside = centers[cell.holds(centers)]
    first = count // 2
    for axis in np.argsort(-np.ptp(inside, axis=0), kind="stable").tolist():
        place = _gap(inside[:, axis], round(len(inside) * first / count))
        if place is None:
            continue
        low, high = cell.cut(axis, place)
        below = int(low.holds(centers).sum())
        if below >= first and len(inside) - below >= count - first:
            return [
                *_halved(centers, low, first, path=f"{path}0"),
                *_halved(centers, high, count - first, path=f"{path}1"),
            ]
    raise OptionError(
        f"{len(inside)} cameras stand at too few places for {count} blocks; expected one place a "
        "block at least; give a smaller --blocks"
    )


def _gap(values: Float64, rank: int) -> float | None:
    """The middle between two different sorted values, nearest to a rank; None if all are equal."""
    ordered = np.sort(values)
    gaps = np.flatnonzero(np.diff(ordered) > 0) + 1
    if not len(gaps):
        return None
    at = gaps[int(np.abs(gaps - rank).argmin())]
    return float((ordered[at - 1] + ordered[at]) / 2)


def seen_points(scene: Scene, names: Sequence[str]) -> dict[str, Float64]:
    """Points (N, 3), world frame, sampled of what each view sees.

    From its sparse points, else from its depth map, else on a plane at half of the extent of the
    cameras.
    """
    rows = {name: row for row, name in enumerate(scene.names)}
    points = scene.points
    tracks = [] if points is None else points.rows_of_views(len(scene))
    spread = float(np.linalg.norm(np.ptp(scene.subset(names).cameras.centers, axis=0)))
    out = {}
    for name in names:
        view = scene[name]
        seen = np.zeros((0, 3))
        if points is not None:
            mine = np.unique(points.point_index[tracks[rows[name]]])
            seen = points.positions[mine[:: max(1, len(mine) // SAMPLES)]]
        if not len(seen):
            depth = view.load().depth if view.has_depth else None
            if depth is None or not (depth > 0).any():
                size = int(view.camera.height[0]), int(view.camera.width[0])
                depth = np.full(size, max(spread, 1e-9) / 2)
            row, column = np.nonzero(depth > 0)
            some = slice(None, None, max(1, len(row) // SAMPLES))
            row, column = row[some], column[some]
            rays = view.camera.rays(0)[row, column] * depth[row, column, None]
            pose = view.camera.world_from_cam[0]
            seen = rays @ pose[:3, :3].T + pose[:3, 3]
        out[name] = seen
    return out


def helpers_of(
    cell: BlockCell, owners: Sequence[str], seen: Mapping[str, Float64], *,
    near: Mapping[str, Sequence[str]], overlap: float,
) -> tuple[str, ...]:  # fmt: skip
    """The helpers of a block: views of other cells that it holds, too.

    ``seen``: see ``seen_points``, of all context views. ``overlap``: 0 to 1; a view is a helper if
    at least the share ``1 - overlap`` of what it sees lies in the cell. At 0 there are no helpers,
    not even nearest views.
    """
    if overlap == 0:
        return ()
    own = set(owners)
    chosen = {other for name in owners for other in near[name]} - own
    chosen |= {
        name
        for name, points in seen.items()
        if name not in own and cell.holds(points).mean() >= 1 - overlap and cell.holds(points).any()
    }
    return tuple(sorted(chosen))
