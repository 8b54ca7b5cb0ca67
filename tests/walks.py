"""Camera paths and what may happen to them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def path(count: int = 40, seed: int = 0) -> np.ndarray:
    """A walk through three dimensions, (N, 4, 4) world_from_cam."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 4, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.stack([3 * np.cos(t), 2 * np.sin(1.7 * t), 0.5 * t], axis=1)
    poses[:, :3, :3] = (
        Rotation.from_euler("y", (20 * t)[:, None], degrees=True) * Rotation.random(rng=rng)
    ).as_matrix()
    return poses


def moved(poses: np.ndarray, *, scale: float = 1.0, seed: int = 1) -> np.ndarray:
    """The same path in another frame and unit."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    out = poses.copy()
    out[:, :3, :3] = rotation @ poses[:, :3, :3]
    out[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + rng.standard_normal(3) * 10
    return out


def disturbed(poses: np.ndarray, *, metres: float = 0.0, degrees: float = 0.0) -> np.ndarray:
    """Each pose off by about so much."""
    rng = np.random.default_rng(2)
    out = poses.copy()
    out[:, :3, 3] += metres * rng.standard_normal((len(poses), 3))
    turn = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal((len(poses), 3)))
    out[:, :3, :3] = poses[:, :3, :3] @ turn.as_matrix()
    return out


def line(count: int = 10) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    return poses
