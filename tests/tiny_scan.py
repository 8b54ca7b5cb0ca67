"""A tiny posed recording of a textured wall behind a square: RGB-D as 7-Scenes, or COLMAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from gvtools.cameras import Cameras
from gvtools.scenes.colmap_writer import write_colmap

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
WALL, SQUARE, HALF = 3.0, 1.8, 0.35


def world_from_cam(index: int) -> np.ndarray:
    """A camera that walks along x and looks along z."""
    pose = np.eye(4)
    pose[0, 3] = -0.5 + 0.2 * index
    return pose


def render(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact picture (uint8) and depth (metres) of the scene."""
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL
    gx, gy = np.meshgrid(x, y)
    near_x = pose[0, 3] + gx * SQUARE
    near_y = pose[1, 3] + gy * SQUARE
    square = (np.abs(near_x) < HALF) & (np.abs(near_y) < HALF)
    depth = np.where(square, SQUARE, WALL)
    wx = pose[0, 3] + gx * depth
    wy = pose[1, 3] + gy * depth
    red = 0.5 + 0.4 * np.sin(7 * wx) * np.cos(5 * wy)
    green = np.where(square, 0.8, 0.3 + 0.2 * np.cos(6 * wy))
    blue = 0.4 + 0.3 * np.sin(3 * wx + 4 * wy)
    rgb = np.stack([red, green, blue], axis=-1)
    return np.rint(rgb * 255).astype(np.uint8), depth


def write_scan(folder: Path, *, views: int = 6) -> Path:
    """Write ``views`` frames; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    K = np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]])
    np.savetxt(folder / "camera-intrinsics.txt", K)
    for i in range(views):
        pose = world_from_cam(i)
        rgb, depth = render(pose)
        stem = folder / f"frame-{i:06d}"
        Image.fromarray(rgb).save(f"{stem}.color.png")
        Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(f"{stem}.depth.png")
        np.savetxt(f"{stem}.pose.txt", pose)
    return folder


def write_colmap_scan(folder: Path, *, views: int = 6, points: int = 60) -> Path:
    """The photographs as a COLMAP project without depth maps; each view sees ``points`` of its own.

    The sparse points are exact. With none, the project has no sparse points.
    """
    rng = np.random.default_rng(0)
    names = tuple(f"view_{i}.png" for i in range(views))
    (folder / "images").mkdir(parents=True)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    poses = np.stack([world_from_cam(i) for i in range(views)])
    positions, pixels = [], []
    for name, pose in zip(names, poses, strict=True):
        rgb, depth = render(pose)
        Image.fromarray(rgb).save(folder / "images" / name)
        column, line = rng.integers(0, WIDTH, points), rng.integers(0, HEIGHT, points)
        xy = np.stack([column + 0.5, line + 0.5], axis=1)
        rays = np.column_stack([xy, np.ones(points)]) @ np.linalg.inv(K).T
        positions.append(rays * depth[line, column, None] + pose[:3, 3])
        pixels.append(xy)
    cameras = Cameras(
        np.repeat(K[None], views, axis=0),
        np.linalg.inv(poses),
        np.full(views, WIDTH),
        np.full(views, HEIGHT),
        names,
    )
    write_colmap(
        folder / "sparse" / "0",
        cameras,
        points=np.concatenate(positions),
        point_index=np.arange(views * points),
        view_index=np.repeat(np.arange(views), points),
        xy=np.concatenate(pixels),
    )
    return folder
