"""Projection without blending: one pixel an observation, the nearest one wins.

There are no tiers and no footprints, so a memory coarser than the image shows holes, and generated
content in front of observed content is seen. Consecutive points hit neighbouring pixels, so the
buffer stays in the cache. Open3D's projection does the same, many times slower.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numba import prange
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.guidance import Guidance
from gvtools.kernels import FAST, compiled
from gvtools.memory.store.store import Store

CHUNK = 512
# Beyond every depth, for a library that takes no infinity.
FARTHEST = float(np.finfo(np.float32).max)
# Open3D carries colours as float32: two of them hold any index below 2³¹ exactly.
_SPLIT = 1 << 16


@dataclass(frozen=True, eq=False)
class NearestImage:
    """What one camera sees of a point cloud, one pixel a point."""

    # (H, W) z-depth, scene units, 0 where empty, and the winning point, -1 where empty. Equal
    # depths go to the lower index.
    depth: NDArray[np.float32]
    index: NDArray[np.int32]
    # (H, W, 3), the winners' colours, 0 where empty; None when none were given.
    colors: NDArray[Any] | None = None


# Nearest depth that is drawn of a memory, in voxel edges.
NEAREST = 1e-3


@compiled(fastmath=FAST)
def _fill(positions, first, last, M, fx, skew, fy, cx, cy, depth_min, width, height, buffer):
    """Depth bits in the high half and the point's index in the low half: one comparison."""
    pixel = np.empty(CHUNK, np.uint32)
    depth = np.empty(CHUNK, np.float32)
    bits = depth.view(np.int32)
    columns = np.int32(width)
    wide = np.float32(width)
    tall = np.float32(height)
    half = np.float32(0.5)
    spare = np.uint32(width * height)
    m00, m01, m02, m03 = M[0, 0], M[0, 1], M[0, 2], M[0, 3]
    m10, m11, m12, m13 = M[1, 0], M[1, 1], M[1, 2], M[1, 3]
    m20, m21, m22, m23 = M[2, 0], M[2, 1], M[2, 2], M[2, 3]
    flat = positions.reshape(-1)
    for start in range(first, last, CHUNK):
        n = min(CHUNK, last - start)
        # Slices indexed from 0: the compiler then knows that no index is negative.
        at = flat[3 * start : 3 * (start + n)]
        for k in range(n):
            x = at[np.uint64(3 * k)]
            y = at[np.uint64(3 * k + 1)]
            z = at[np.uint64(3 * k + 2)]
            pz = m20 * x + m21 * y + m22 * z + m23
            px = m00 * x + m01 * y + m02 * z + m03
            py = m10 * x + m11 * y + m12 * z + m13
            inverse = np.float32(1) / pz
            u = (fx * px + skew * py) * inverse + cx + half
            v = fy * py * inverse + cy + half
            inside = (u >= 0) & (u < wide) & (v >= 0) & (v < tall) & (pz > depth_min)
            # Out of view goes to a spare cell behind the image, so the loop has no branch.
            pixel[k] = np.uint32(np.int32(v) * columns + np.int32(u)) if inside else spare
            depth[k] = pz
        for k in range(n):
            key = (np.int64(bits[k]) << 32) | np.int64(start + k)
            cell = np.uint64(pixel[k])
            # Always stored: a branch here would be mispredicted at every new minimum.
            buffer[cell] = min(buffer[cell], key)


@compiled(parallel=True)
def _fill_parallel(positions, parts, M, fx, skew, fy, cx, cy, depth_min, width, height, buffers):
    count = len(positions)
    for t in prange(parts):
        buffers[t] = np.iinfo(np.int64).max
        _fill(
            positions, t * count // parts, (t + 1) * count // parts, M, fx, skew, fy, cx, cy,
            depth_min, width, height, buffers[t],
        )  # fmt: skip


@compiled(parallel=True)
def _merge(buffers, depth, bits, index):
    parts = len(buffers)
    for i in prange(len(depth)):
        key = buffers[0, i]
        for t in range(1, parts):
            key = min(key, buffers[t, i])
        if key == np.iinfo(np.int64).max:
            depth[i] = 0
            index[i] = -1
        else:
            index[i] = np.int32(key & 0xFFFFFFFF)
            bits[i] = np.int32(key >> 32)


@compiled(parallel=True)
def _gather(colors, index, out):
    for i in prange(len(index)):
        for c in range(3):
            out[i, c] = colors[index[i], c] if index[i] >= 0 else 0


def project_nearest(
    positions: NDArray[np.float32],
    camera: Cameras,
    *,
    colors: NDArray[Any] | None = None,
    depth_min: float = 0.0,
) -> NearestImage:
    """Project points (N, 3), N < 2³¹, into one camera, one pixel each; the nearest depth wins.

    Points at ``depth_min`` and before it are left out. ``colors`` (N, 3) are looked up for the
    winners.
    """
    height, width = int(camera.height[0]), int(camera.width[0])
    K = camera.K[0]
    parts = min(numba.get_num_threads(), max(1, len(positions) // (4 * CHUNK)))
    buffers = np.empty((parts, height * width + 1), np.int64)
    single = np.float32
    # Integer pixel centres, as Open3D counts them: column = floor(u + 0.5).
    _fill_parallel(
        np.ascontiguousarray(positions), parts, camera.cam_from_world[0].astype(np.float32),
        single(K[0, 0]), single(K[0, 1]), single(K[1, 1]), single(K[0, 2] - 0.5),
        single(K[1, 2] - 0.5), single(depth_min), width, height, buffers,
    )  # fmt: skip
    depth = np.empty(height * width, np.float32)
    index = np.empty(height * width, np.int32)
    _merge(buffers[:, : height * width], depth, depth.view(np.int32), index)
    rgb = None
    if colors is not None:
        rgb = np.empty((height * width, 3), colors.dtype)
        _gather(colors, index, rgb)
        rgb = rgb.reshape(height, width, 3)
    return NearestImage(depth.reshape(height, width), index.reshape(height, width), rgb)


def project_open3d(positions: NDArray[np.float32], camera: Cameras) -> NearestImage:
    """The same through Open3D's ``project_to_rgbd_image``; the winners' numbers go as colours.

    Open3D multiplies depths by 1000 and cuts at 3 units unless told otherwise, and its pixel
    centres are integers; both are set here.
    """
    from gvtools.o3d import o3d

    if camera.K[0, 0, 1] != 0:
        raise OptionError(
            f"{camera.names[0]}: Open3D's projection ignores skew and K has {camera.K[0, 0, 1]:g} "
            "px of it; choose another splat backend"
        )
    tensor, number = o3d.core.Tensor.from_numpy, np.arange(len(positions))
    tag = np.stack([number // _SPLIT, number % _SPLIT, np.zeros_like(number)], axis=1)
    cloud = o3d.t.geometry.PointCloud(tensor(np.ascontiguousarray(positions, np.float32)))
    cloud.point.colors = tensor(tag.astype(np.float32))
    K = camera.K[0].copy()
    K[:2, 2] -= 0.5
    pose = camera.cam_from_world[0].copy()
    image = cloud.project_to_rgbd_image(
        int(camera.width[0]), int(camera.height[0]), tensor(K), tensor(pose), 1.0, FARTHEST
    )
    depth = image.depth.as_tensor().numpy()[..., 0].copy()
    tags = image.color.as_tensor().numpy().astype(np.int32)
    index = tags[..., 0] * _SPLIT + tags[..., 1]
    return NearestImage(depth, np.where(depth > 0, index, -1).astype(np.int32))


def project_one_pixel(store: Store, cameras: Cameras, *, open3d: bool = False) -> Guidance:
    """Project the memory into cameras of one image size, one pixel an observation.

    ``open3d`` takes Open3D's projection instead of our own kernel.
    """
    shape = (len(cameras), int(cameras.height[0]), int(cameras.width[0]))
    depth, index = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
    for i, camera in enumerate(store.frame.seen_from(cameras)):
        if not len(store):
            break
        positions = store.columns.positions
        # A point within the rounding of the camera's plane is neither before nor behind it.
        least = NEAREST * store.voxel
        image = (
            project_open3d(positions, camera)
            if open3d
            else project_nearest(positions, camera, depth_min=least)
        )
        depth[i], index[i] = image.depth, image.index
    valid = index >= 0

    def of_winners(values: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros((*shape, *values.shape[1:]), values.dtype)
        out[valid] = values[index[valid]]
        return out

    colors = of_winners(store.columns.colors)
    return Guidance(
        cameras, np.divide(colors, np.float32(255), dtype=np.float32), depth, valid,
        of_winners(store.confidence), of_winners(store.generated), of_winners(store.scanned),
    )  # fmt: skip
