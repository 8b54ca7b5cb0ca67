"""A tiny posed RGB-D recording in the 7-Scenes layout: a textured wall behind a square."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

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
