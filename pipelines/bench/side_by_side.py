"""Fusing and projecting timed against Open3D, turn by turn in one process."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.one_pixel import NearestImage, project_nearest
from pipelines.bench import open3d_peers, procedural_cloud

# OpenMP workers of the call before keep a core busy for up to 0.2 s, waiting for more work.
SETTLE_SECONDS = 0.25


@dataclass(frozen=True)
class Comparison:
    """One row of a benchmark."""

    name: str  # what was done
    peer: str  # what a user would otherwise call
    ours: list[float]  # seconds of each turn
    theirs: list[float]  # likewise
    note: str = ""  # what else was found, such as how far the results agree

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready: medians, shortest times (nearest to the cost), ratios (below 1 is faster)."""
        medians = [statistics.median(seconds) for seconds in (self.ours, self.theirs)]
        shortest = [min(self.ours), min(self.theirs)]
        return {
            "name": self.name,
            "peer": self.peer,
            "ours_s": medians[0],
            "peer_s": medians[1],
            "ours_min_s": shortest[0],
            "peer_min_s": shortest[1],
            "repeats": len(self.ours),
            "note": self.note,
            "ratio": medians[0] / medians[1],
            "ratio_of_minima": shortest[0] / shortest[1],
        }


def alternate(
    calls: Sequence[Callable[[int], object]],
    repeat: int,
    *,
    steady: bool = False,
) -> list[list[float]]:
    """Seconds of each call, the calls taking turns so that disturbances hit all alike.

    A turn before them compiles and fills caches.
    """
    seconds: list[list[float]] = [[] for _ in calls]
    for turn in range(1 + repeat):
        for call, kept in zip(calls, seconds, strict=True):
            gc.collect()
            time.sleep(SETTLE_SECONDS)
            if steady:
                call(turn)
            start = time.perf_counter()
            call(turn)
            elapsed = time.perf_counter() - start
            if turn:
                kept.append(elapsed)
    return seconds


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

    ``frames``: ``repeat`` + 1 of rgb, depth and camera; the first is the warm-up.
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

    calls: list[Callable[[int], object]] = [
        lambda turn: memory.observe(*frames[turn], round=number),
        lambda turn: old.append(clouds[turn]).voxel_down_sample(voxel),
        lambda turn: volume.integrate(*pictures[turn], frames[turn][2]),
    ]
    seconds = alternate(calls, repeat)
    name = f"fuse {frames[0][0].shape[1]}x{frames[0][0].shape[0]} into {voxels:,} voxels"
    return [
        Comparison(name, "Open3D concatenate + voxel_down_sample", seconds[0], seconds[1]),
        Comparison(name, "Open3D VoxelBlockGrid integrate", seconds[0], seconds[2]),
    ]


VIEWS = 16
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
    return Comparison(name, "Open3D VoxelBlockGrid ray_cast", ours_s, peer_s)


def one_pixel_rows(count: int, *, repeat: int) -> list[Comparison]:
    """One-pixel projection into 504x504 of points in view, in voxel order and shuffled."""
    camera = Cameras.pinhole(ONE_PIXEL_SIDE, ONE_PIXEL_SIDE, focal=400.0, name="front")
    points = procedural_cloud.layers_in_view(count, camera)
    return compare_one_pixel(points, camera, repeat=repeat)


def compare_one_pixel(
    points: NDArray[np.float32], camera: Cameras, *, repeat: int
) -> list[Comparison]:
    """The two projections of the same points; ours gathers the winners' colours as well.

    ``points``: (N, 3) float32, world frame, in voxel order; N below 2**24.
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
        Comparison(name, f"{peer}, same order", seconds[0], seconds[1], note),
        Comparison(name, f"{peer}, random order", seconds[0], seconds[2]),
    ]
