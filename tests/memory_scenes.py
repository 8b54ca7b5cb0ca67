"""Cameras, point sets and small memories that the tests of the memory share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.memory.back_projection import back_project
from gvtools.memory.local_frame import LocalFrame
from gvtools.memory.points import PointSet
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory


def camera(
    *, width=32, height=24, focal=30.0, center=(0, 0, 0), rotation=None, skew=0.0, name="view"
) -> Cameras:
    """One camera that looks along z unless ``rotation`` (a rotation vector) turns it."""
    pose = np.eye(4)
    if rotation is not None:
        pose[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(center, float)
    K = np.array([[focal, skew, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(K[None], pose[None], np.array([width]), np.array([height]), (name,))


def random_camera(rng: np.random.Generator, *, spread=0.3, name="view") -> Cameras:
    return camera(
        center=rng.normal(0, spread, 3), rotation=rng.normal(0, 0.1, 3), skew=0.5, name=name
    )


def points(
    positions, *, source: Cameras | None = None, origin=(0, 0, 0), colors=None, confidence=1.0,
    spacing=0.05, free_depth=None,
) -> PointSet:  # fmt: skip
    """A point set of world positions (N, 3)."""
    positions = np.asarray(positions, float).reshape(-1, 3)
    count = len(positions)
    colors = np.full((count, 3), 128) if colors is None else np.broadcast_to(colors, (count, 3))
    return PointSet(
        (positions - origin).astype(np.float32),
        np.ascontiguousarray(colors, np.uint8),
        np.array(np.broadcast_to(confidence, count), np.float32),
        np.array(np.broadcast_to(spacing, count), np.float32),
        camera() if source is None else source,
        LocalFrame.at(origin),
        free_depth,
        {},
    )


def random_points(rng: np.random.Generator, count: int, *, origin=(0, 0, 0), name="view"):
    """Scattered points and a square patch before a random camera, and how far it saw."""
    scattered = rng.uniform((-2, -1.5, 1), (2, 1.5, 5), (count, 3))
    patch = rng.uniform((-0.5, -0.5, -0.02), (0.5, 0.5, 0.02), (2 * count, 3))
    patch += rng.uniform((-0.8, -0.6, 1.5), (0.8, 0.6, 4))
    return points(
        np.concatenate([scattered, patch]),
        source=random_camera(rng, name=name),
        origin=origin,
        colors=rng.integers(0, 256, (3 * count, 3)),
        confidence=rng.uniform(0.1, 2, 3 * count),
        spacing=rng.uniform(0.05, 0.3, 3 * count),
        free_depth=np.full((6, 8), max(0, rng.uniform(-3, 3)), np.float32),
    )


def random_memory(
    seed: int, *, views=7, most=60, voxel=0.08, options: MemoryOptions | None = None
) -> SpatialMemory:
    """Observed views in rounds of two; from the third view on, some are generated."""
    rng = np.random.default_rng(seed)
    memory = SpatialMemory(voxel, origin=rng.normal(0, 3, 3), options=options)
    for view in range(int(rng.integers(2, views + 1))):
        fresh = random_points(
            rng, int(rng.integers(1, most)), origin=memory.origin, name=f"v{view}"
        )
        generated = bool(view >= 2 and rng.random() < 0.4)
        memory.fuse(fresh, round=view // 2, generated=generated)
    return memory


def plane_view(
    source: Cameras, depth: float | np.ndarray, *, color=(200, 100, 50), origin=(0, 0, 0)
) -> PointSet:
    """What back-projection makes of a depth image of one colour or of a colour image."""
    shape = (int(source.height[0]), int(source.width[0]))
    rgb = np.array(np.broadcast_to(np.asarray(color, np.uint8), (*shape, 3)))
    image = np.array(np.broadcast_to(np.asarray(depth, np.float32), shape))
    return back_project(rgb, image, source, frame=LocalFrame.at(origin))


def saved_bytes(memory: SpatialMemory, folder: Path) -> bytes:
    """The memory's file."""
    path = folder / "saved.npz"
    memory.save(path)
    return path.read_bytes()
