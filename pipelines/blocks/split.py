"""A project split into blocks: cells, owners and helpers, one set of poses for all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.capture.project import replaced_folder
from gvtools.errors import OptionError
from gvtools.runs.poses import with_poses
from gvtools.scenes.reduced import reduced
from gvtools.scenes.selection import select
from gvtools.view_selection import nearest_views
from pipelines.blocks.block import SceneBlock
from pipelines.blocks.cells import NEAREST, VIEWS_PER_BLOCK, cut_cells, helpers_of, seen_points
from pipelines.blocks.write import PROJECTS, write_blocks
from pipelines.reconstruction.prepare import refined_poses_of

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene


def split(
    scene: Scene,
    out: Path,
    *,
    blocks: int | None = None,
    overlap: float = 0.8,
    context: str = "all",
    layout: str = PROJECTS,
    refine_poses: bool = True,
    max_side: int | None = 1600,
    reading: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> tuple[SceneBlock, ...]:
    """Write the blocks of a project.

    Args:
        scene: the project.
        out: a folder that is not there yet, or empty.
        blocks: how many; None: one for each VIEWS_PER_BLOCK context views.
        overlap: 0 to 1; a view is a helper of another block if at least the share ``1 - overlap``
            of what it sees lies in that block's cell.
        context: selection of the given views; the others are the blocks' targets.
        layout: "projects" or "chunks", see ``pipelines.blocks.write``.
        refine_poses: refine the poses of RGB-D views, once for all blocks, as a run of the whole
            project would.
        max_side: longer side of pictures for that, pixels; that of the runs. None: as they are.
        reading: how the project is read, JSON-ready; kept in the blocks.
        say: is called with a line of text at each step.

    Returns:
        The blocks in order of their names.
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
                name, tuple(cells), scene.address, reading or {}, cell, owners,
                helpers_of(cell, owners, seen, near=near, overlap=overlap), targets,
                {view: (posed or scene)[view].camera.cam_from_world[0] for view in held},
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
