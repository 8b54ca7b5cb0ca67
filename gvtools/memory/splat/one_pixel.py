"""Projection without blending: one pixel an observation, the nearest one wins.

The plain choice, and the check of the others: no tiers, no footprints, so a memory coarser than the
image shows holes, and generated content in front of observed content is seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.guidance import Guidance
from gvtools.memory.splat.nearest import project_nearest, project_open3d

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory

# Open3D carries colours as float32: two of them hold any index below 2³¹ exactly.
_SPLIT = 1 << 16


def project_one_pixel(memory: SpatialMemory, cameras: Cameras, *, open3d: bool = False) -> Guidance:
    """Project the memory into cameras of one image size, one pixel an observation.

    Args:
        memory: what is projected.
        cameras: V cameras of one image size.
        open3d: through Open3D's ``project_to_rgbd_image`` instead of our own kernel.

    Returns:
        The colour, confidence and origin of the nearest observation of each pixel.
    """
    shape = (len(cameras), int(cameras.height[0]), int(cameras.width[0]))
    depth = np.zeros(shape, np.float32)
    index = np.full(shape, -1, np.int32)
    for i, camera in enumerate(cameras):
        if len(memory):
            depth[i], index[i] = (_open3d if open3d else _nearest)(memory, camera)
    valid = index >= 0
    rows = index[valid]
    rgb = np.zeros((*shape, 3), np.float32)
    rgb[valid] = memory.records.color[rows] / np.float32(255)
    confidence = np.zeros(shape, np.float32)
    confidence[valid] = memory.confidence[rows]
    generated = np.zeros(shape, np.bool_)
    generated[valid] = memory.generated[rows]
    return Guidance(cameras, rgb, depth, valid, confidence, generated)


def _nearest(
    memory: SpatialMemory, camera: Cameras
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    records, n = memory.records, len(memory)
    xyz = (records.x[:n], records.y[:n], records.z[:n])
    image = project_nearest(xyz, memory.frame.seen_from(camera))
    return image.depth, image.index


def _open3d(
    memory: SpatialMemory, camera: Cameras
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The winners' numbers travel through Open3D as colours."""
    number = np.arange(len(memory))
    tag = np.stack([number // _SPLIT, number % _SPLIT, np.zeros_like(number)], axis=1)
    depth, tags = project_open3d(
        memory.records.position, tag.astype(np.float32), memory.frame.seen_from(camera)
    )
    index = tags[..., 0].astype(np.int32) * _SPLIT + tags[..., 1].astype(np.int32)
    return depth, np.where(depth > 0, index, -1).astype(np.int32)
