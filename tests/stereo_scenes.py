"""Scenes of known depth for the stereo tests: textured planes seen by pinhole cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from gvtools.cameras import Cameras
from gvtools.scenes.scene import Frame, Scene, View

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0


@dataclass(frozen=True, eq=False)
class PlaneScene:
    """Views of the plane ``normal`` · X = ``distance`` (world frame), and their true depth."""

    scene: Scene
    depths: tuple[np.ndarray, ...]


def texture(x: np.ndarray, y: np.ndarray, seed: int = 0) -> np.ndarray:
    """A smooth random pattern in [0, 1] with detail from 0.2 to 1 units, defined everywhere."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.broadcast(x, y).shape)
    weight = 0.0
    for wavelength in (1.2, 0.6, 0.32, 0.18):
        for _ in range(4):
            angle, phase = rng.uniform(0, 2 * np.pi, 2)
            turn = (x * np.cos(angle) + y * np.sin(angle)) / wavelength
            total = total + np.sin(2 * np.pi * turn + phase)
            weight += 1
    return 0.5 + 0.5 * np.tanh(2.2 * total / np.sqrt(weight))


def camera(center: tuple[float, float, float], turn: float = 0.0, name: str = "view") -> Cameras:
    """A camera that looks along z, turned about y by ``turn`` radians."""
    cosine, sine = np.cos(turn), np.sin(turn)
    pose = np.eye(4)
    pose[:3, :3] = [[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]
    pose[:3, 3] = -pose[:3, :3] @ np.array(center, float)
    K = np.array([[FOCAL, 0, WIDTH / 2 + 1.3], [0, FOCAL * 1.01, HEIGHT / 2 - 0.7], [0, 0, 1]])
    return Cameras(K[None], pose[None], np.array([WIDTH]), np.array([HEIGHT]), (name,))


def plane_depth(view: Cameras, normal: np.ndarray, distance: float) -> np.ndarray:
    """(H, W) z-depth of the plane at the pixel centres."""
    rays = view.rays() @ view.world_from_cam[0, :3, :3].T
    return (distance - view.centers[0] @ normal) / (rays @ normal)


def picture(view: Cameras, normal: np.ndarray, distance: float, *, blank: bool = False) -> Frame:
    """What the camera sees of the textured plane; ``blank`` leaves a third without texture."""
    depth = plane_depth(view, normal, distance)
    rays = view.rays() @ view.world_from_cam[0, :3, :3].T
    point = view.centers[0] + depth[..., None] * rays
    value = texture(point[..., 0], point[..., 1])
    if blank:
        value = np.where(point[..., 0] > 0.25, 0.5, value)
    rgb = np.repeat(np.round(255 * value)[..., None], 3, axis=-1).astype(np.uint8)
    return Frame(rgb)


def plane_scene(
    *, slope: tuple[float, float] = (0.0, 0.0), distance: float = 2.0, blank: bool = False,
    count: int = 5, turns: bool = True,
) -> PlaneScene:  # fmt: skip
    """``count`` cameras side by side before the plane z = distance + slope · (x, y)."""
    normal = np.array([-slope[0], -slope[1], 1.0])
    step = 0.12
    views, depths = [], []
    for i in range(count):
        along = (i - (count - 1) / 2) * step
        turn = -0.4 * along / distance if turns else 0.0
        made = camera((along, 0.06 * (i % 2), 0.02 * i), turn, f"v{i}")
        load = partial(picture, made, normal, distance, blank=blank)
        views.append(View(f"v{i}", made, load))
        depths.append(plane_depth(made, normal, distance))
    return PlaneScene(Scene(Path("planes"), "colmap", tuple(views)), tuple(depths))


def niche_depth(view: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) z-depth of a wall at 2 with a niche whose back is at 3, and where that is seen."""
    x, y, _ = np.moveaxis(view.centers[0] + 2 * view.rays(), -1, 0)
    inside = (np.abs(x) < 0.45) & (np.abs(y) < 0.35)
    return np.where(inside, 3.0, 2.0), inside


def niche_picture(view: Cameras, shading: str, noise: float, seed: int) -> Frame:
    """A textured wall, and a niche whose back is shaded alone."""
    depth, inside = niche_depth(view)
    x, y, _ = np.moveaxis(view.centers[0] + depth[..., None] * view.rays(), -1, 0)
    shades = {"ramp": 0.5 + 0.25 * x + 0.1 * y, "bowl": 0.75 - 0.3 * (x**2 + y**2)}
    value = np.where(inside, shades[shading], texture(3 * x, 3 * y))
    value = value + np.random.default_rng(seed).normal(0, noise, value.shape)
    gray = np.clip(np.round(255 * value), 0, 255).astype(np.uint8)
    return Frame(np.repeat(gray[..., None], 3, axis=-1))


def niche_scene(shading: str, noise: float) -> Scene:
    """Five views side by side, twice as large as the others of this module."""
    views = []
    for i in range(5):
        made = camera(((i - 2) * 0.12, 0.05 * (i % 2), 0.0), name=f"v{i}")
        made = made.resized(2 * WIDTH, 2 * HEIGHT)
        views.append(View(f"v{i}", made, partial(niche_picture, made, shading, noise, i)))
    return Scene(Path("niche"), "colmap", tuple(views))


def turning_scene(
    jitter: float, *, at: tuple[float, float, float] = (0.0, 0.0, 0.0), count: int = 4
) -> Scene:
    """Pictures that one camera takes as it turns; its positions differ by ``jitter``."""
    views = []
    for i in range(count):
        true = camera((0.0, 0.0, 0.0), 0.05 * i, f"v{i}")
        told = camera((at[0] + jitter * i, at[1], at[2]), 0.05 * i, f"v{i}")
        load = partial(picture, true, np.array([0.0, 0.0, 1.0]), 2.0)
        views.append(View(f"v{i}", told, load))
    return Scene(Path("turning"), "colmap", tuple(views))
