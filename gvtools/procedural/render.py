"""Pictures and exact depth of procedural scenes by ray casting.

A pixel's colour is the mean of 2 x 2 rays, in linear light; its depth is that of the one ray
through its centre, so that it is a surface's and not a mean of two.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numba
import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.procedural.color import encode_srgb
from gvtools.procedural.geometry import Geometry
from gvtools.procedural.ray_cast import cast, world_rays
from gvtools.procedural.shading import Look, colors

Float32 = NDArray[np.float32]

SUPERSAMPLE = 2
# So many rays are followed at once: they fit a processor's cache.
BLOCK = 2**15


def radiance(
    geometry: Geometry, look: Look, cameras: Cameras, *, supersample: int = SUPERSAMPLE
) -> tuple[Float32, Float32]:
    """Linear light and depth that cameras of one size see.

    Args:
        geometry: of the scene.
        look: of the scene.
        cameras: V of them.
        supersample: rays along a pixel's side, for the colour.

    Returns:
        (V, H, W, 3) and (V, H, W) float32.
    """
    height, width = int(cameras.height[0]), int(cameras.width[0])
    fine = cameras.resized(width * supersample, height * supersample)
    pixel = 1 / np.sqrt(fine.K[:, 0, 0] * fine.K[:, 1, 1])
    depth = cast(geometry, cameras).depth
    pictures = []
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        for view in range(len(cameras)):
            rays = world_rays(fine, view).reshape(-1, 6)
            blocks = np.array_split(rays, -(-len(rays) // BLOCK))
            follow = partial(colors, geometry, look, pixel=float(pixel[view]))
            light = np.concatenate(list(pool.map(follow, blocks)))
            light = light.reshape(height, supersample, width, supersample, 3)
            pictures.append(light.mean((1, 3)))
    return np.stack(pictures), depth


def developed(light: Float32, exposure: float) -> NDArray[np.uint8]:
    """(..., 3) linear light to 8-bit sRGB by the tone curve of ``color.encode_srgb``."""
    return encode_srgb(light * np.float32(exposure))
