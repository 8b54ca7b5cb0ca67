"""Projecting a memory, against Open3D's ray casting and its one-pixel projection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.one_pixel import NearestImage, project_nearest
from pipelines.bench import open3d_peers, procedural_cloud
from pipelines.bench.side_by_side import Comparison, alternate, comparison

VIEWS = 16
VOXEL = 0.005  # scene units, ours
PEER_VOXEL = 0.01  # scene units, the TSDF's: the peer at 5 mm is slower still
ONE_PIXEL_SIDE = 504
SPLAT_BOX = 3_200_000  # voxels of the box's walls


def splat_rows(
    points: int, *, repeat: int, width: int = 640, height: int = 480
) -> list[Comparison]:
    """Our splatting against ray_cast, then one-pixel projection of ``points`` / 4 and ``points``.

    The memory and the TSDF hold the same frames of a box that surrounds them.
    """
    size = procedural_cloud.box_size(min(points, SPLAT_BOX), VOXEL)
    memory, volume = SpatialMemory(VOXEL), open3d_peers.TsdfVolume(PEER_VOXEL)
    for turn in np.linspace(0, 2 * np.pi, VIEWS, endpoint=False):
        camera = procedural_cloud.inside_camera(size, turn=turn, width=width, height=height)
        rgb, depth = procedural_cloud.photograph(size, camera)
        memory.observe(rgb, depth, camera, round=0)
        volume.integrate(*open3d_peers.images(rgb, depth), camera)
    half_step = np.pi / VIEWS
    cameras = [
        procedural_cloud.inside_camera(size, turn=turn + half_step, width=width, height=height)
        for turn in np.linspace(0, 2 * np.pi, repeat + 1, endpoint=False)
    ]
    rows = [compare_splatting(memory, volume, cameras)]
    for count in (max(1, points // 4), points):
        rows += one_pixel_rows(count, repeat=repeat)
    return rows


def compare_splatting(
    memory: SpatialMemory, volume: open3d_peers.TsdfVolume, cameras: list[Cameras]
) -> Comparison:
    """A memory into cameras against ray_cast into the same; the first camera is the warm-up."""
    camera = cameras[0]
    ours_s, peer_s = alternate(
        [lambda turn: memory.project(cameras[turn]), lambda turn: volume.ray_cast(cameras[turn])],
        len(cameras) - 1,
        steady=True,
    )
    name = f"project {memory.voxels:,} voxels into {camera.width[0]}x{camera.height[0]}"
    return comparison(name, "Open3D VoxelBlockGrid ray_cast", ours_s, peer_s=peer_s)


def one_pixel_rows(count: int, *, repeat: int) -> list[Comparison]:
    """One-pixel projection into 504x504 of points in view, in voxel order and shuffled."""
    K = np.array([[400.0, 0, 252], [0, 400.0, 252], [0, 0, 1]])
    side = np.array([ONE_PIXEL_SIDE])
    camera = Cameras(K[None], np.eye(4)[None], side, side, ("front",))
    points = procedural_cloud.layers_in_view(count, camera)
    return compare_one_pixel(points, camera, repeat=repeat)


def compare_one_pixel(
    points: NDArray[np.float32], camera: Cameras, *, repeat: int
) -> list[Comparison]:
    """The two projections of the same points; ours gathers the winners' colours as well.

    Args:
        points: (N, 3) float32, world frame, in voxel order; N below 2**24.
        camera: a batch of one.
        repeat: timed turns.
    """
    rng = np.random.default_rng(1)
    count = len(points)
    # The first channel tells which point won; float32 holds it exactly.
    colors = rng.random((count, 3), np.float32)
    colors[:, 0] = np.arange(count)
    shuffled = rng.permutation(count)
    ordered = open3d_peers.cloud(points, colors)
    random = open3d_peers.cloud(points[shuffled], colors[shuffled])

    def ours(_: int) -> NearestImage:
        return project_nearest(points, camera, colors=colors)

    image = ours(0)
    peer_rgb, peer_depth = open3d_peers.one_pixel(ordered, camera)
    both = (image.index >= 0) & (peer_depth > 0)
    same = float((image.index == peer_rgb[..., 0].astype(np.int64))[both].mean())
    filled = float(((image.index >= 0) == (peer_depth > 0)).mean())
    note = f"same winner in {same:.4%} of pixels, filled alike in {filled:.4%}"
    seconds = alternate(
        [
            ours,
            lambda _: open3d_peers.one_pixel(ordered, camera),
            lambda _: open3d_peers.one_pixel(random, camera),
        ],
        repeat,
        steady=True,
    )
    name = f"one pixel a point, {count:,} points into {camera.width[0]}x{camera.height[0]}"
    peer = "Open3D project_to_rgbd_image"
    return [
        comparison(name, f"{peer}, same order", seconds[0], peer_s=seconds[1], note=note),
        comparison(name, f"{peer}, random order", seconds[0], peer_s=seconds[2]),
    ]
