"""Fusing one frame into a large memory, against Open3D."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.bench import open3d_peers, procedural_cloud
from pipelines.bench.side_by_side import Comparison, alternate, comparison

WIDTH, HEIGHT = 640, 480
VOXEL = 0.005  # scene units; a fifth to a pixel's footprint in the middle of the box

Frame = tuple[NDArray[np.uint8], NDArray[np.float32], Cameras]


def fuse_rows(points: int, *, repeat: int) -> list[Comparison]:
    """One 640x480 frame into a memory of about ``points`` voxels of a box's walls."""
    size = procedural_cloud.box_size(points, VOXEL)
    memory = SpatialMemory(VOXEL)
    for wall in procedural_cloud.walls(size, VOXEL):
        memory.fuse(wall, round=0)
    turns = np.linspace(0, 2 * np.pi, repeat + 1, endpoint=False)
    frames: list[Frame] = []
    for turn in turns:
        camera = procedural_cloud.inside_camera(size, turn=turn, width=WIDTH, height=HEIGHT)
        frames.append((*procedural_cloud.photograph(size, camera), camera))
    return compare_fusing(memory, frames, repeat=repeat)


def compare_fusing(memory: SpatialMemory, frames: list[Frame], *, repeat: int) -> list[Comparison]:
    """Fuse frames one after the other into ``memory`` (which keeps them), peers in turn.

    Ours lifts the frame's depth and fuses it. The first peer is given the frame's points ready
    lifted and, as its memory, one point for each of our voxels; the second integrates the frame
    into a TSDF of the same voxel edge, the blocks of all frames being there already.

    Args:
        memory: what to fuse into.
        frames: ``repeat`` + 1 of rgb, depth and camera; the first is the warm-up.
        repeat: timed frames.
    """
    voxel, voxels = memory.voxel, memory.voxels
    number = memory.rounds[-1] + 1 if memory.rounds else 0
    old = open3d_peers.cloud(
        memory.columns.positions, memory.columns.colors.astype(np.float32) / 255
    ).voxel_down_sample(voxel)
    lifted = [back_project(rgb, depth, camera) for rgb, depth, camera in frames]
    clouds = [
        open3d_peers.cloud(points.positions, points.colors.astype(np.float32) / 255)
        for points in lifted
    ]
    volume = open3d_peers.TsdfVolume(voxel, blocks=40000)
    pictures = [open3d_peers.images(rgb, depth) for rgb, depth, _ in frames]
    for picture, (_, _, camera) in zip(pictures, frames, strict=True):
        volume.integrate(*picture, camera)

    def ours(turn: int) -> None:
        rgb, depth, camera = frames[turn]
        memory.observe(rgb, depth, camera, round=number)

    def concatenate(turn: int) -> None:
        open3d_peers.concatenated(old, clouds[turn], voxel)

    def integrate(turn: int) -> None:
        volume.integrate(*pictures[turn], frames[turn][2])

    seconds = alternate([ours, concatenate, integrate], repeat)
    name = f"fuse {frames[0][0].shape[1]}x{frames[0][0].shape[0]} into {voxels:,} voxels"
    return [
        comparison(name, "Open3D concatenate + voxel_down_sample", seconds[0], peer_s=seconds[1]),
        comparison(name, "Open3D VoxelBlockGrid integrate", seconds[0], peer_s=seconds[2]),
    ]
