"""A small project of exact geometry on disk, and the memory that its views make."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from gvtools.cameras import concatenate
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.scenes.scene import Scene
from gvtools.scenes.transforms_json import read_transforms, write_transforms
from pipelines.procedural_cloud import inside_camera, photograph

# Walls in the middle of a voxel, where rounding cannot move them into another.
SIZE = np.array([3.03, 1.83, 2.43])
WIDTH, HEIGHT = 96, 72
VOXEL = 0.03


def write_box(folder: Path, views: int = 6, *, names: list[str] | None = None) -> Scene:
    """The inside of a box seen by cameras that turn a little from view to view."""
    names = names or [f"view_{i}.png" for i in range(views)]
    cameras = [
        inside_camera(SIZE, turn=0.12 * i, width=WIDTH, height=HEIGHT) for i in range(len(names))
    ]
    for camera, name in zip(cameras, names, strict=True):
        rgb, depth = photograph(SIZE, camera)
        file = folder / "images" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rgb).save(file)
        (folder / "depth").mkdir(exist_ok=True)
        np.save(folder / "depth" / f"{name.replace('/', '_')}.npy", depth)
    write_transforms(
        folder / "transforms.json",
        concatenate(cameras),
        image_paths=[f"images/{name}" for name in names],
        depth_paths=[f"depth/{name.replace('/', '_')}.npy" for name in names],
    )
    return read_transforms(folder)


def fused(
    scene: Scene,
    rows: list[int],
    *,
    generated: tuple[int, ...] = (),
    voxel: float = VOXEL,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> SpatialMemory:
    """A memory of some views, one round each; those in ``generated`` as a completer's."""
    memory = SpatialMemory(voxel, origin=origin)
    for number, row in enumerate(rows):
        view = scene.views[row]
        frame = view.load()
        assert frame.depth is not None
        points = back_project(frame.rgb, frame.depth, view.camera, frame=memory.frame)
        memory.fuse(points, round=number, generated=row in generated)
    return memory
