"""Projects split into blocks: COLMAP workspaces of undistorted pictures that stand by themselves.

    OUT/0_1/{block.json,context.txt,targets.txt} OUT/0_1/sparse/0 OUT/0_1/images/NAME
    OUT/0_1/masks/NAME.png OUT/0_1/stereo/depth_maps/NAME.npz

or, as Hierarchical-3DGS has its chunks, with the pictures once for all:

    OUT/aligned/sparse/0 OUT/rectified/{images,masks,stereo}
    OUT/chunks/0_1/{center.txt,extent.txt,sparse/0,block.json,context.txt,targets.txt}

A picture that needs no undistortion is a hard link to the project's own file, or a copy where links
cannot be; so is a block's of another block's. Symbolic links would break on another machine.

A block (``block.json`` in its folder) owns the views whose cameras stand in its cell, and holds
others as helpers: they belong to another block, but see what this one's views see. Cells are boxes,
closed below and open above, that fill all of space without overlap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer

from gvtools.capture.project import replaced_folder
from gvtools.errors import OptionError, ProjectError
from gvtools.files import link_or_copy, write_json, write_text
from gvtools.prefetch import prefetch
from gvtools.runs.layout import file_stems
from gvtools.runs.poses import with_poses
from gvtools.runs.target_files import write_png
from gvtools.scenes.colmap import CHUNK_BOX
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.images import read_image
from gvtools.scenes.resized import reduced
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.scenes.selection import select
from gvtools.untrusted import read_json
from gvtools.view_selection import nearest_views
from pipelines.reconstruction.prepare import refined_poses_of

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


PROJECTS, CHUNKS = "projects", "chunks"
CONTEXT, TARGETS = "context.txt", "targets.txt"


def block_folder(out: Path, name: str, layout: str) -> Path:
    """Where a block's model and its ``block.json`` are."""
    return out / name if layout == PROJECTS else out / "chunks" / name


def write_blocks(out: Path, scene: Scene, blocks: Sequence[SceneBlock], *, layout: str) -> None:
    """Write all blocks into an empty folder."""
    holders = {
        name: [block_folder(out, block.name, layout) for block in blocks if name in _held(block)]
        for name in scene.names
    }
    if layout == CHUNKS:
        holders = {name: [out / "rectified"] for name, places in holders.items() if places}
    views = [scene[name] for name, places in holders.items() if places]
    for view, frame in zip(views, prefetch(lambda view: view.load(), views), strict=True):
        _write_view(view, frame, holders[view.name])
    # Of all cameras, wider by its longest side: chunks' boxes are finite.
    centers = scene.cameras.centers
    side = max(float(np.ptp(centers, axis=0).max()), 1e-9)
    lowest, highest = centers.min(axis=0) - side, centers.max(axis=0) + side
    for block in blocks:
        folder = block_folder(out, block.name, layout)
        folder.mkdir(parents=True, exist_ok=True)
        _write_model(folder / "sparse/0", scene, _held(block))
        block.save(folder)
        write_text(folder / CONTEXT, "".join(f"{name}\n" for name in block.context))
        write_text(folder / TARGETS, "".join(f"{name}\n" for name in block.targets))
        if layout == CHUNKS:
            low, high = np.maximum(block.low, lowest), np.minimum(block.high, highest)
            for file, values in zip(CHUNK_BOX, ((low + high) / 2, high - low), strict=True):
                write_text(folder / file, " ".join(str(value) for value in values.tolist()))
    if layout == CHUNKS:
        _write_model(out / "aligned/sparse/0", scene, scene.names)


def _held(block: SceneBlock) -> tuple[str, ...]:
    """All views of a block."""
    return tuple(sorted({*block.context, *block.targets}))


def _write_view(view: View, frame: Frame, places: Sequence[Path]) -> None:
    """A view's picture, mask and depth, below each of some folders."""
    file_stems((view.name,))  # refuses a name that leads out of a folder
    picture, mask, depth = (f"images/{view.name}", f"masks/{view.name}.png",
                            f"stereo/depth_maps/{view.name}.npz")  # fmt: skip
    own = _own_picture(view, frame)
    first = _parent_made(places[0] / picture)
    if own is None:
        # By content, not by its name, is it known to be a PNG.
        write_png(first, frame.rgb)
    else:
        link_or_copy(own, first)
    if frame.mask is not None:
        white = np.where(frame.mask, np.uint8(255), np.uint8(0))
        write_png(_parent_made(places[0] / mask), white)
    if frame.depth is not None:
        with _parent_made(places[0] / depth).open("wb") as file:
            np.savez_compressed(file, depth=frame.depth)
    for place in places[1:]:
        for name in (picture, mask, depth):
            if (places[0] / name).exists():
                link_or_copy(places[0] / name, _parent_made(place / name))


def _own_picture(view: View, frame: Frame) -> Path | None:
    """The project's file that holds just the view's pixels; None where they were resampled."""
    with suppress(ProjectError):
        # What an alpha channel leaves out stands in the mask, too.
        if view.files and np.array_equal(read_image(view.files[0]).rgb, frame.rgb):
            return view.files[0]
    return None


def _parent_made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_model(folder: Path, scene: Scene, names: Sequence[str]) -> None:
    """The model of some views, with the points that they see."""
    cameras = scene.subset(names).cameras
    points = scene.points
    if points is None:
        write_colmap(folder, cameras)
        return
    row = {name: number for number, name in enumerate(names)}
    here = np.array([row.get(name, -1) for name in scene.names])[points.view_index]
    mine = here >= 0
    kept, point = np.unique(points.point_index[mine], return_inverse=True)
    write_colmap(
        folder, cameras, points=points.positions[kept], colors=points.colors[kept],
        point_index=point.reshape(-1), view_index=here[mine], xy=points.xy[mine],
    )  # fmt: skip


def read_blocks(folder: Path) -> Iterator[tuple[Path, SceneBlock]]:
    """The blocks below a folder of either layout, with their folders, in order of their names."""
    for place in (folder, folder / "chunks"):
        for path in sorted(place.glob("*/block.json")):
            yield path.parent, SceneBlock.load(path.parent)


def split(
    scene: Scene,
    out: Path,  # a folder that is not there yet, or empty
    *,
    blocks: int | None = None,  # how many; None: one for each VIEWS_PER_BLOCK context views
    overlap: float = 0.8,
    context: str = "all",
    layout: str = PROJECTS,  # "projects" or "chunks", see ``pipelines.blocks.split``
    refine_poses: bool = True,
    max_side: int | None = 1600,
    reading: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> tuple[SceneBlock, ...]:
    """Write the blocks of a project.

    ``overlap``: 0 to 1; a view is a helper of another block if at least the share ``1 - overlap``
    of what it sees lies in that block's cell. ``max_side``: longer side of pictures for that,
    pixels; that of the runs. None: as they are. Returns the blocks in order of their names.
    """
    names = tuple(sorted(select(scene.names, context)))
    others = tuple(sorted(set(scene.names) - set(names)))
    # Views belong to cells by their given poses, even if refinement moves them across a face.
    centers = scene.subset(names).cameras.centers
    count = blocks or max(1, -(-len(names) // VIEWS_PER_BLOCK))
    cells = cut_cells(centers, count)
    with replaced_folder(out) as work:
        posed = _posed(scene, names, others, say=say, max_side=max_side) if refine_poses else None
        seen = seen_points(posed or scene, names)
        near = _nearest(scene, names)
        found = []
        for name, cell in cells.items():
            owners = _inside(scene, names, cell.holds)
            held = (*owners, *(targets := _inside(scene, others, cell.holds)))
            block = SceneBlock(
                name=name,
                names=tuple(cells),
                project=scene.address,
                reading=dict(reading or {}),
                low=cell.low,
                high=cell.high,
                owners=owners,
                targets=targets,
                helpers=helpers_of(cell, owners, seen, near=near, overlap=overlap),
                poses={view: (posed or scene)[view].camera.cam_from_world[0] for view in held},
                refined=posed is not None,
            )
            found.append(block)
            say(
                f"block {name}: {len(owners)} views of its own, {len(block.helpers)} helpers, "
                f"{len(targets)} held out"
            )
        write_blocks(work, posed or scene, found, layout=layout)
    return tuple(found)


def _inside(scene: Scene, names: Sequence[str], holds: Callable[[Any], Any]) -> tuple[str, ...]:
    if not names:
        return ()
    inside = holds(scene.subset(names).cameras.centers)
    return tuple(name for name, here in zip(names, inside, strict=True) if here)


def _posed(
    scene: Scene,
    names: tuple[str, ...],
    others: tuple[str, ...],
    *,
    say: Callable[[str], None],
    max_side: int | None,
) -> Scene | None:
    """The project with refined poses; None if the given ones are kept."""
    # ``refined`` needs a target; without any, the first view stands in, and its result is not used.
    targets = scene.subset(others or names[:1]).cameras
    recorded = scene.kind != "colmap" and all(scene[name].has_depth for name in names)
    found = refined_poses_of(reduced(scene, max_side), names, targets, recorded=recorded, say=say)
    if found is None:
        return None
    moved = with_poses(scene, names, found.context)
    return with_poses(moved, others, found.targets) if others else moved


def _nearest(scene: Scene, names: tuple[str, ...]) -> dict[str, list[str]]:
    """Names of the NEAREST other views of each view."""
    cameras = scene.subset(names).cameras
    out = {}
    for row, name in enumerate(names):
        others = [other for other in range(len(names)) if other != row]
        if not others:
            return {name: []}
        rows = nearest_views(cameras[others], cameras[row], NEAREST)
        out[name] = [names[others[at]] for at in rows]
    return out
