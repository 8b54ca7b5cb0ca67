"""Open3D peers of the timings: its TSDF volume and its point clouds.

Open3D counts pixel centres as integers; K is moved by half a pixel on the way in.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.o3d import o3d

BLOCK_SIDE = 16  # voxels, Open3D's default
FAR = 1e3  # scene units; beyond every depth here
SMALLEST_WEIGHT = 1.0


def intrinsics(camera: Cameras) -> o3d.core.Tensor:
    """K for Open3D, whose first pixel's centre is (0, 0)."""
    K = camera.K[0].copy()
    K[:2, 2] -= 0.5
    return o3d.core.Tensor(K)


def extrinsics(camera: Cameras) -> o3d.core.Tensor:
    """cam_from_world for Open3D."""
    return o3d.core.Tensor(np.ascontiguousarray(camera.cam_from_world[0]))


class TsdfVolume:
    """Open3D's VoxelBlockGrid with the calls of its integration and ray-casting tutorials."""

    def __init__(self, voxel: float, *, blocks: int = 60000) -> None:
        core = o3d.core
        self.grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (core.float32, core.float32, core.float32),
            ((1), (1), (3)),
            voxel,
            BLOCK_SIDE,
            blocks,
            core.Device("CPU:0"),
        )

    def integrate(
        self, rgb: o3d.t.geometry.Image, depth: o3d.t.geometry.Image, camera: Cameras
    ) -> None:
        """One frame: which blocks it touches, then their voxels."""
        K, pose = intrinsics(camera), extrinsics(camera)
        blocks = self.grid.compute_unique_block_coordinates(depth, K, pose, 1.0, FAR)
        self.grid.integrate(blocks, depth, rgb, K, K, pose, 1.0, FAR)

    def ray_cast(self, camera: Cameras) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Rgb (H, W, 3) in [0, 1] and depth (H, W), scene units, 0 = none."""
        table = self.grid.hashmap()
        result = self.grid.ray_cast(
            table.key_tensor()[table.active_buf_indices()],
            intrinsics(camera),
            extrinsics(camera),
            int(camera.width[0]),
            int(camera.height[0]),
            ["depth", "color"],
            1.0,
            0.05,
            FAR,
            SMALLEST_WEIGHT,
        )
        return result["color"].numpy(), result["depth"].numpy()[..., 0]


def images(
    rgb: NDArray[np.uint8], depth: NDArray[np.float32]
) -> tuple[o3d.t.geometry.Image, o3d.t.geometry.Image]:
    """A frame as Open3D integrates it: float colours in [0, 1] and float depth."""
    color = np.ascontiguousarray(rgb, np.float32) / np.float32(255)
    return (
        o3d.t.geometry.Image(o3d.core.Tensor(color)),
        o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth, np.float32))),
    )


def cloud(
    positions: NDArray[np.floating[Any]], colors: NDArray[np.floating[Any]]
) -> o3d.t.geometry.PointCloud:
    """A tensor point cloud, held as float32; positions (N, 3) scene units, colours (N, 3)."""
    tensors = [
        o3d.core.Tensor(np.ascontiguousarray(array, np.float32)) for array in (positions, colors)
    ]
    points = o3d.t.geometry.PointCloud(tensors[0])
    points.point.colors = tensors[1]
    return points


def one_pixel(
    points: o3d.t.geometry.PointCloud, camera: Cameras
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """project_to_rgbd_image: rgb (H, W, 3) and depth (H, W), 0 = none."""
    image = points.project_to_rgbd_image(
        int(camera.width[0]),
        int(camera.height[0]),
        intrinsics(camera),
        extrinsics(camera),
        1.0,
        FAR,
    )
    return image.color.as_tensor().numpy(), image.depth.as_tensor().numpy()[..., 0]
