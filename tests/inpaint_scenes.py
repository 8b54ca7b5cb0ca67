"""Scenes with known answers for the completers: textured planes, and real frames warped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import ndimage

from gvtools.cameras import Cameras, invert_rigid, rigid_transform
from gvtools.completers import ContextView
from gvtools.guidance import Guidance

HEIGHT, WIDTH, FOCAL = 120, 160, 150.0


def camera(x: float = 0.0) -> Cameras:
    """Looks along z from (x, 0, 0)."""
    K = np.array([[[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]])
    pose = np.eye(4)
    pose[0, 3] = -x
    return Cameras(K, pose[None], np.array([WIDTH]), np.array([HEIGHT]), (f"{x:g}",))


def wall_view(x: float = 0.0, *, stripes: float = 9.0) -> tuple[np.ndarray, np.ndarray]:
    """rgb and depth of a striped, slanted wall z = 4 - 0.3 X seen by ``camera(x)``."""
    cam = camera(x)
    rays = cam.rays()
    z = (4 - 0.3 * x) / (1 + 0.3 * rays[..., 0])
    points = rays * z[..., None] + cam.centers[0]
    phase = stripes * points[..., 0]
    shade = 0.5 + 0.4 * np.sin(phase) * np.cos(0.7 * stripes * points[..., 1])
    rgb = np.stack([shade, 0.2 + 0.0 * shade, 0.9 - 0.5 * shade], axis=-1)
    return rgb.astype(np.float32), z.astype(np.float32)


def guidance(rgb: np.ndarray, depth: np.ndarray, valid: np.ndarray, cam: Cameras) -> Guidance:
    """One view of projected memory, empty outside ``valid``."""
    return Guidance(
        cam,
        np.where(valid[..., None], rgb, 0).astype(np.float32)[None],
        np.where(valid, depth, 0).astype(np.float32)[None],
        valid[None],
        valid.astype(np.float32)[None],
        np.zeros_like(valid)[None],
    )


def psnr(estimate: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """Peak signal-to-noise ratio over some pixels, peak 1."""
    return float(-10 * np.log10(np.mean((estimate - truth)[where] ** 2)))


def kitchen_view(folder: Path, frame: int) -> ContextView:
    """A real RGB-D frame."""
    from skimage.io import imread

    stem = folder / f"frame-{frame:06d}"
    pose, _ = rigid_transform(np.loadtxt(f"{stem}.pose.txt"), what=str(stem))
    K = np.array([[[522.9, 0, 318.4], [0, 522.9, 235.0], [0, 0, 1]]])
    depth = imread(f"{stem}.depth.png").astype(np.float32) / 1000
    rgb = imread(f"{stem}.color.jpg").astype(np.float32) / 255
    cam = Cameras(K, invert_rigid(pose)[None], np.array([640]), np.array([480]), (stem.name,))
    return ContextView(stem.name, cam, rgb, np.where(depth < 60, depth, 0))


def warp(source: ContextView, target: Cameras) -> Guidance:
    """The source's points in the target's pixels: nearest wins, each covers 2x2 pixels."""
    depth = source.depth
    assert depth is not None
    low = ndimage.minimum_filter(np.where(depth > 0, depth, np.inf), 3)
    flat = (depth > 0) & (ndimage.maximum_filter(depth, 3) - low < 0.05 * depth)
    world = (source.camera.rays() * depth[..., None])[flat] @ source.camera.world_from_cam[
        0, :3, :3
    ].T + source.camera.centers[0]
    xy, z = (part[0] for part in target.project(world))
    height, width = int(target.height[0]), int(target.width[0])
    far = np.full(height * width, np.inf)
    rgb = np.zeros((height * width, 3), np.float32)
    order = np.argsort(-z, kind="stable")
    order = order[z[order] > 0]
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = np.floor(xy[order] - 0.5 + step).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel, point = (row * width + column)[inside], order[inside]
        winner = np.full(height * width, -1)
        winner[pixel] = point
        hit = np.flatnonzero(winner >= 0)
        hit = hit[z[winner[hit]] < 0.98 * far[hit]]
        far[hit], rgb[hit] = z[winner[hit]], source.rgb[flat][winner[hit]]
    valid = np.isfinite(far).reshape(height, width)
    shape = (height, width)
    return guidance(rgb.reshape(*shape, 3), far.reshape(shape), valid, target)
