"""A room of exact geometry for benchmarks: the inside of a box, painted by a formula.

No data is needed, depth is a closed form, and its surface decides how many voxels it fills.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, rigid_poses
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.views import PointSet

Float64 = NDArray[np.float64]

# The box's sides in proportion to each other.
PROPORTIONS = np.array([5.0, 3.0, 4.0])


def box_size(points: int, voxel: float) -> Float64:
    """(3,) sides, scene units, of a box whose walls fill about ``points`` voxels."""
    a, b, c = PROPORTIONS
    area = 2 * (a * b + b * c + c * a)
    sides = PROPORTIONS * np.sqrt(points * voxel**2 / area)
    # Walls in the middle of a voxel, so that rounding never moves them to the next one.
    return (2 * np.floor(sides / voxel / 2) + 1) * voxel


def paint(positions: Float64) -> NDArray[np.uint8]:
    """(..., 3) uint8 colours of world points (..., 3): soft waves."""
    waves = np.sin(positions * 9.0) + 0.5 * np.sin(positions[..., ::-1] * 23.0)
    return np.round(127.5 + 80 * waves / 1.5).astype(np.uint8)


def walls(size: Float64, voxel: float) -> list[PointSet]:
    """A point in each voxel of the six walls, one point set a wall, seen from the middle."""
    half = size / 2
    out = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        grid_u = np.arange(round(size[u] / voxel) + 1) * voxel - half[u]
        grid_v = np.arange(round(size[v] / voxel) + 1) * voxel - half[v]
        for side in (-1.0, 1.0):
            positions = np.empty((len(grid_u), len(grid_v), 3))
            positions[..., axis] = side * half[axis]
            positions[..., u] = grid_u[:, None]
            positions[..., v] = grid_v[None, :]
            flat = positions.reshape(-1, 3)
            count = len(flat)
            out.append(
                PointSet(
                    flat.astype(np.float32),
                    paint(flat),
                    np.ones(count, np.float32),
                    np.full(count, voxel, np.float32),
                    inside_camera(size, turn=0.0, width=640, height=480),
                    LocalFrame.at(),
                    None,
                    {},
                )
            )
    return out


def inside_camera(size: Float64, *, turn: float, width: int, height: int) -> Cameras:
    """A level camera near the middle of the box, turned by ``turn`` radians about y."""
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    center = 0.08 * size * np.array([np.cos(turn), np.sin(3 * turn), np.sin(turn)])
    pose = rigid_poses(rotation, -rotation @ center)
    focal = 0.82 * width
    return Cameras.pinhole(width, height, focal=focal, cam_from_world=pose, name=f"{turn:.4f}")


def photograph(size: Float64, camera: Cameras) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Rgb (H, W, 3) uint8 and exact z-depth (H, W) float32 of a camera inside the box."""
    world_from_cam = camera.world_from_cam[0]
    directions = camera.rays() @ world_from_cam[:3, :3].T
    center = world_from_cam[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (np.sign(directions) * size / 2 - center) / directions
    # Rays have z = 1 in the camera's frame, so the ray parameter is the z-depth.
    depth = np.where(directions == 0, np.inf, reach).min(axis=-1)
    return paint(center + depth[..., None] * directions), depth.astype(np.float32)


def layers_in_view(count: int, camera: Cameras) -> NDArray[np.float32]:
    """(N, 3) float32 points of 4 wavy surfaces behind each other, all in view, in block order."""
    rng = np.random.default_rng(0)
    width, height = int(camera.width[0]), int(camera.height[0])
    uv = rng.uniform(0.01, 0.99, (count, 2)) * (width, height)
    layer = rng.integers(0, 4, count)
    waves = np.sin(uv[:, 0] / 37) * np.cos(uv[:, 1] / 53)
    z = 2.0 + layer + 0.2 * waves
    rays = np.column_stack([uv, np.ones(count)]) @ np.linalg.inv(camera.K[0]).T
    pose = camera.world_from_cam[0]
    points = (rays * z[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    cell = np.floor(points / 0.08).astype(np.int64)
    return points[np.lexsort(cell.T)].astype(np.float32)
