"""Projects split into blocks: COLMAP workspaces of undistorted pictures that stand by themselves.

    OUT/0_1/{block.json,context.txt,targets.txt} OUT/0_1/sparse/0 OUT/0_1/images/NAME
    OUT/0_1/masks/NAME.png OUT/0_1/stereo/depth_maps/NAME.npz

or, as Hierarchical-3DGS has its chunks, with the pictures once for all:

    OUT/aligned/sparse/0 OUT/rectified/{images,masks,stereo}
    OUT/chunks/0_1/{center.txt,extent.txt,sparse/0,block.json,context.txt,targets.txt}

A picture that needs no undistortion is a hard link to the project's own file, or a copy where links
cannot be; so is a block's of another block's. Symbolic links would break on another machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from gvtools.capture.project import replaced_folder
from gvtools.errors import OptionError, ProjectError
from gvtools.files import link_or_copy, write_text
from gvtools.prefetch import prefetch
from gvtools.runs.layout import file_stems
from gvtools.runs.poses import with_poses
from gvtools.runs.target_files import write_png
from gvtools.scenes.colmap import CHUNK_BOX
from gvtools.scenes.colmap_model import write_colmap
from gvtools.scenes.images import read_image
from gvtools.scenes.resized import reduced
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.scenes.selection import select
from gvtools.view_selection import nearest_views
from pipelines.blocks.block import (
    NEAREST,
    VIEWS_PER_BLOCK,
    SceneBlock,
    cut_cells,
    helpers_of,
    seen_points,
)
from pipelines.reconstruction.prepare import refined_poses_of

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


def by_name(found: Mapping[str, SceneBlock], *, what: str) -> tuple[SceneBlock, ...]:
    """All blocks of one split, in order of their names."""
    first = next(iter(found.values()))
    missing = [name for name in first.names if name not in found]
    if missing:
        raise ProjectError(
            f"{what}: {len(found)} of {len(first.names)} blocks; expected all; missing: "
            f"{', '.join(missing)}"
        )
    alike = all(
        (block.names, block.refined) == (first.names, first.refined) for block in found.values()
    )
    owned = [name for block in found.values() for name in block.owners]
    if not alike or len(set(owned)) != len(owned):
        raise ProjectError(f"{what}: blocks of different splits; expected those of one")
    return tuple(found[name] for name in first.names)


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
    if not 0 <= overlap <= 1:
        raise OptionError(f"overlap {overlap:g}; expected 0 to 1")
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
                name=name, names=tuple(cells), project=scene.address, reading=dict(reading or {}),
                low=cell.low, high=cell.high, owners=owners, targets=targets,
                helpers=helpers_of(cell, owners, seen, near=near, overlap=overlap),
                poses={view: (posed or scene)[view].camera.cam_from_world[0] for view in held},
                refined=posed is not None,
            )  # fmt: skip
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
    scene: Scene, names: tuple[str, ...], others: tuple[str, ...], *,
    say: Callable[[str], None], max_side: int | None,
) -> Scene | None:  # fmt: skip
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
