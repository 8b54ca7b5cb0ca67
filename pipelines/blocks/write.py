"""Blocks on disk: COLMAP workspaces of undistorted pictures that stand by themselves.

    OUT/0_1/{block.json,context.txt,targets.txt} OUT/0_1/sparse/0 OUT/0_1/images/NAME
    OUT/0_1/masks/NAME.png OUT/0_1/stereo/depth_maps/NAME.npz

or, as Hierarchical-3DGS has its chunks, with the pictures once for all:

    OUT/aligned/sparse/0 OUT/rectified/{images,masks,stereo}
    OUT/chunks/0_1/{center.txt,extent.txt,sparse/0,block.json,context.txt,targets.txt}

A picture that needs no undistortion is a hard link to the project's own file, or a copy where links
cannot be; so is a block's of another block's. Symbolic links would break on another machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.files import link_or_copy, write_text
from gvtools.prefetch import prefetch
from gvtools.runs.layout import file_stems
from gvtools.runs.target_files import write_png
from gvtools.scenes.colmap import CHUNK_BOX
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.images import read_image
from gvtools.scenes.scene import Frame, Scene, View
from pipelines.blocks.block import BlockCell, SceneBlock

PROJECTS, CHUNKS = "projects", "chunks"
LAYOUTS = (PROJECTS, CHUNKS)
CONTEXT, TARGETS = "context.txt", "targets.txt"


def block_folder(out: Path, name: str, layout: str) -> Path:
    """Where a block's model and its ``block.json`` are."""
    return out / name if layout == PROJECTS else out / "chunks" / name


def write_blocks(out: Path, scene: Scene, blocks: Sequence[SceneBlock], *, layout: str) -> None:
    """Write all blocks into an empty folder.

    Args:
        out: the folder.
        scene: the project, in the poses that the blocks are to have.
        blocks: what they hold.
        layout: one of LAYOUTS.
    """
    holders = {
        name: [block_folder(out, block.name, layout) for block in blocks if name in _held(block)]
        for name in scene.names
    }
    if layout == CHUNKS:
        holders = {name: [out / "rectified"] for name, places in holders.items() if places}
    views = [scene[name] for name, places in holders.items() if places]
    for view, frame in zip(views, prefetch(lambda view: view.load(), views), strict=True):
        _write_view(view, frame, holders[view.name])
    box = _box(scene.cameras)
    for block in blocks:
        folder = block_folder(out, block.name, layout)
        folder.mkdir(parents=True, exist_ok=True)
        _write_model(folder / "sparse/0", scene, _held(block))
        block.save(folder)
        write_text(folder / CONTEXT, "".join(f"{name}\n" for name in block.context))
        write_text(folder / TARGETS, "".join(f"{name}\n" for name in block.targets))
        if layout == CHUNKS:
            low, high = np.maximum(block.cell.low, box.low), np.minimum(block.cell.high, box.high)
            for file, values in zip(CHUNK_BOX, ((low + high) / 2, high - low), strict=True):
                write_text(folder / file, " ".join(str(value) for value in values.tolist()))
    if layout == CHUNKS:
        _write_model(out / "aligned/sparse/0", scene, scene.names)


def _held(block: SceneBlock) -> tuple[str, ...]:
    """All views of a block."""
    return tuple(sorted({*block.context, *block.targets}))


def _box(cameras: Cameras) -> BlockCell:
    """The box of all cameras, wider by its longest side: chunks' boxes are finite."""
    centers = cameras.centers
    side = max(float(np.ptp(centers, axis=0).max()), 1e-9)
    return BlockCell(centers.min(axis=0) - side, centers.max(axis=0) + side)


def _write_view(view: View, frame: Frame, places: Sequence[Path]) -> None:
    """A view's picture, mask and depth, below each of some folders."""
    file_stems((view.name,))  # refuses a name that leads out of a folder
    picture, mask, depth = (f"images/{view.name}", f"masks/{view.name}.png",
                            f"stereo/depth_maps/{view.name}.npz")  # fmt: skip
    own = _own_picture(view, frame)
    first, *others = _made(places, picture)
    if own is None:
        # By content, not by its name, is it known to be a PNG.
        write_png(first, frame.rgb)
    else:
        link_or_copy(own, first)
    _repeat(first, others)
    if frame.mask is not None:
        first, *others = _made(places, mask)
        write_png(first, np.where(frame.mask, np.uint8(255), np.uint8(0)))
        _repeat(first, others)
    if frame.depth is not None:
        first, *others = _made(places, depth)
        with first.open("wb") as file:
            np.savez_compressed(file, depth=frame.depth)
        _repeat(first, others)


def _own_picture(view: View, frame: Frame) -> Path | None:
    """The project's file that holds just the view's pixels; None where they were resampled."""
    for path in view.files[:1]:
        try:
            found = read_image(path)
        except ProjectError:
            return None
        # What an alpha channel leaves out stands in the mask, too.
        if found.rgb.shape == frame.rgb.shape and np.array_equal(found.rgb, frame.rgb):
            return path
    return None


def _made(places: Sequence[Path], name: str) -> list[Path]:
    paths = [place / name for place in places]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
    return paths


def _repeat(path: Path, others: Sequence[Path]) -> None:
    for other in others:
        link_or_copy(path, other)


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
