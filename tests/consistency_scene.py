"""A slanted textured wall behind a textured square, drawn exactly for any pinhole camera."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.evaluation.posed_picture import PosedPicture

# The wall is z = WALL + SLANT x; the square is |x|, |y| < HALF at z = SQUARE.
WALL, SLANT = 3.0, 0.15
SQUARE, HALF = 1.9, 0.35
TEXELS = 90  # per scene unit
SIDE = 512


def camera(
    center: tuple[float, float, float] = (0, 0, 0),
    *,
    turn: tuple[float, float, float] = (0, 0, 0),
    width: int = 160,
    height: int = 120,
) -> Cameras:
    """A camera that looks along z, turned by x, y and z degrees about its own axes."""
    rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ np.array(center, float)
    focal = 0.9 * width
    K = np.array([[focal, 0, 0.48 * width], [0, focal, 0.51 * height], [0, 0, 1]])
    return Cameras(K[None], pose[None], np.array([width]), np.array([height]), ("camera",))


def picture(at: Cameras, name: str = "view", *, seed: int = 0, square: bool = True) -> PosedPicture:
    """What the camera sees: exact depth at pixel centres, and a band-limited texture."""
    rotation, center = at.cam_from_world[0, :3, :3], at.centers[0]
    rays = at.rays() @ rotation
    with np.errstate(divide="ignore"):
        depth = (WALL + SLANT * center[0] - center[2]) / (rays[..., 2] - SLANT * rays[..., 0])
        near = (SQUARE - center[2]) / rays[..., 2]
    hit = center + near[..., None] * rays
    on_square = square & (near > 0) & (np.abs(hit[..., :2]) < HALF).all(-1)
    depth = np.where(on_square, near, np.where(depth > 0, depth, 0))
    hit = center + depth[..., None] * rays
    rgb = np.where(
        on_square[..., None], _painted(hit, seed=2 * seed + 1), _painted(hit, seed=2 * seed)
    )
    return PosedPicture(name, at, np.where(depth[..., None] > 0, rgb, 0), depth.astype(np.float32))


def moved(
    view: PosedPicture,
    *,
    turn: tuple[float, float, float] = (0, 0, 0),
    shift: tuple[float, float, float] = (0, 0, 0),
) -> PosedPicture:
    """The same picture with a wrong camera: turned (degrees) and shifted about its own axes."""
    wrong = np.eye(4)
    wrong[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    wrong[:3, 3] = shift
    return replace(
        view, camera=replace(view.camera, cam_from_world=wrong @ view.camera.cam_from_world)
    )


def blurred(view: PosedPicture, sigma: float) -> PosedPicture:
    """The same view out of focus."""
    return replace(view, rgb=gaussian_filter(view.rgb, (sigma, sigma, 0)))


def noisy(view: PosedPicture, sigma: float) -> PosedPicture:
    """The same view with noise of ``sigma`` grey levels."""
    noise = np.random.default_rng(5).normal(0, sigma, view.rgb.shape)
    return replace(view, rgb=np.clip(np.rint(view.rgb + noise), 0, 255).astype(np.uint8))


def _painted(places: np.ndarray, *, seed: int) -> np.ndarray:
    """(H, W, 3) uint8 colours of a repeating texture at the x and y of world places."""
    at = [places[..., 1] * TEXELS, places[..., 0] * TEXELS]
    texture = _texture(seed)
    seen = [map_coordinates(texture[..., c], at, order=1, mode="grid-wrap") for c in range(3)]
    return np.clip(np.stack(seen, -1) * 25 + 128, 0, 255).astype(np.uint8)


@cache
def _texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    texture = np.zeros((SIDE, SIDE, 3))
    for sigma in (2.0, 5.0, 14.0):
        layer = gaussian_filter(rng.normal(size=texture.shape), (sigma, sigma, 0), mode="wrap")
        texture += layer / layer.std()
    return texture
