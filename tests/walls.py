"""An exact room of three textured walls for the pose probe, and its fixtures."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.evaluation.posed_picture import PosedPicture

Float64 = NDArray[np.float64]
WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
TEXEL = 0.006  # scene units
# Normal n, offset d (n · X = d), and the two axes that the wall's texture is laid along.
WALLS = (
    (np.array([0.0, 0, 1]), 3.0, np.array([1.0, 0, 0]), np.array([0, 1.0, 0])),
    (np.array([0.0, 1, 0]), 1.0, np.array([1.0, 0, 0]), np.array([0, 0, 1.0])),
    (np.array([-1.0, 0, 0]), 1.2, np.array([0, 0, 1.0]), np.array([0, 1.0, 0])),
)


def blotches(rng: np.random.Generator) -> Float64:
    """(512, 512) in [0, 1], without seams: random blotches of several sizes, which SIFT likes."""
    total = np.zeros((512, 512))
    for sigma in (2.5, 5, 10, 20):
        noise = gaussian_filter(rng.standard_normal(total.shape), sigma, mode="wrap")
        total += noise / noise.std()
    return np.clip(0.5 + 0.12 * total, 0, 1)


def camera_at(
    center: ArrayLike, *, turn: ArrayLike = (0, 0, 0), scale: float = 1.0, name: str = "view"
) -> Cameras:
    """A camera at ``center``, turned by Euler angles (x, y, z) in degrees from looking along z."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(center, np.float64)
    K = np.array([[FOCAL, 0, 157.0], [0, FOCAL * 1.01, 122.0], [0, 0, 1]])
    camera = Cameras(K[None], pose[None], np.array([WIDTH]), np.array([HEIGHT]), (name,))
    return camera.resized(round(WIDTH * scale), round(HEIGHT * scale))


def cast(camera: Cameras) -> tuple[NDArray[np.int64], Float64, Float64]:
    """Wall hit by each pixel's centre, its z-depth, and the point."""
    direction = camera.rays() @ camera.world_from_cam[0, :3, :3].T
    center = camera.centers[0]
    with np.errstate(divide="ignore"):
        z = np.stack([(offset - n @ center) / (direction @ n) for n, offset, _, _ in WALLS])
    z[~(z > 0)] = np.inf
    wall = z.argmin(axis=0)
    depth = z.min(axis=0)
    return wall, depth, center + depth[..., None] * direction


def photograph(camera: Cameras, textures: list[Float64], *, samples: int = 3) -> PosedPicture:
    """The room seen by ``camera``: exact depth, colour averaged over samples x samples a pixel."""
    size = np.array([camera.width[0], camera.height[0]])
    wall, _, point = cast(camera.resized(*(size * samples)))
    grey = np.zeros(wall.shape)
    for i, (_, _, along, across) in enumerate(WALLS):
        here = wall == i
        at = np.stack([point[here] @ across, point[here] @ along]) / TEXEL
        grey[here] = map_coordinates(textures[i], at, order=1, mode="grid-wrap")
    small = grey.reshape(size[1], samples, size[0], samples).mean(axis=(1, 3))
    rgb = np.repeat(np.rint(255 * small).astype(np.uint8)[..., None], 3, axis=2)
    depth = cast(camera)[1].astype(np.float32)
    return PosedPicture(camera.names[0], camera, rgb, depth)


class Take(Protocol):
    """Takes a picture at ``camera`` that claims to be from ``claim`` (the same when None)."""

    def __call__(self, camera: Cameras, claim: Cameras | None = None) -> PosedPicture: ...
