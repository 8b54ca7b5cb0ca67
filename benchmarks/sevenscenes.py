"""The figures of the README: a posed RGB-D recording against Open3D, in one process, on the CPU.

Every second frame is context, the frames between are targets; no completer. Usage:

    python benchmarks/sevenscenes.py FOLDER [--only quality fuse pixel tenfold sweep] [--json FILE]

FOLDER is a 7-Scenes folder with depth registered to colour; another posed RGB-D folder will do.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.evaluation.images import psnr
from gvtools.files import write_json
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.store.views import PointSet
from gvtools.scenes.project import open_project
from gvtools.scenes.selection import select
from pipelines.bench import open3d_peers, side_by_side
from pipelines.bench.side_by_side import alternate
from pipelines.commands.bench import report
from pipelines.console import Console

VOXEL = 0.005  # metres
TSDF_VOXEL = 0.01
COPIES = 9
APART = 60.0  # metres between the copies of the scene
PARTS = ("quality", "fuse", "pixel", "tenfold", "sweep")


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame with its camera: rgb (H, W, 3) uint8, depth (H, W) float32, metres."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    camera: Cameras


def main() -> None:
    """Measure the parts that are asked for, print them, and write them as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    console = Console()
    scene = open_project(args.folder)
    context = shots(scene, "every:2")
    figures: dict[str, Any] = {
        "scene": args.folder.name,
        "context": len(context),
        "cpus": os.cpu_count(),
        "python": platform.python_version(),
        "load_before": os.getloadavg()[0],
    }
    if "quality" in args.only:
        figures["quality"] = quality(context, shots(scene, "every:2+1"), console)
    if "fuse" in args.only:
        rows = side_by_side.compare_fusing(
            built(context, VOXEL),
            [(s.rgb, s.depth, s.camera) for s in shots(scene, "every:2+1")[: args.repeat + 1]],
            repeat=args.repeat,
        )
        report(rows, console, None)
        figures["fuse"] = [row.to_dict() for row in rows]
    if "pixel" in args.only:
        rows = [
            row
            for count in (1_000_000, 4_000_000)
            for row in side_by_side.one_pixel_rows(count, repeat=args.repeat)
        ]
        target = shots(scene, "first:2")[1].camera
        side = int(min(target.height[0], 504))
        window = target.cropped(0, 0, width=side, height=side)
        points = built(context, VOXEL).columns.positions
        rows += side_by_side.compare_one_pixel(points, window, repeat=args.repeat)
        report(rows, console, None)
        figures["pixel"] = [row.to_dict() for row in rows]
    if "tenfold" in args.only:
        figures["tenfold"] = tenfold(context, shots(scene, "every:2+1"), args.repeat, console)
    if "sweep" in args.only:
        figures["sweep"] = sweep(context, shots(scene, "every:2+1"), console)
    figures["load_after"] = os.getloadavg()[0]
    if args.json is not None:
        write_json(args.json, figures)


def shots(scene: Any, selection: str) -> list[Shot]:
    """The frames of a selection, loaded."""
    out = []
    for name in select(scene.names, selection):
        view = scene[name]
        frame = view.load()
        out.append(Shot(frame.rgb, frame.depth, view.camera))
    return out


def built(context: list[Shot], voxel: float, options: MemoryOptions | None = None) -> SpatialMemory:
    """A memory of the context."""
    memory = SpatialMemory(voxel, options=options)
    for shot in context:
        memory.observe(shot.rgb, shot.depth, shot.camera, round=0)
    return memory


def quality(context: list[Shot], targets: list[Shot], console: Console) -> list[dict[str, Any]]:
    """PSNR on valid pixels, coverage and seconds a view of ours and of the peers.

    Times are of the three taking turns on the same target, the first target being the warm-up.
    """
    memories, ours_s = {}, {}
    for voxel in (TSDF_VOXEL, VOXEL):
        start = time.perf_counter()
        memories[voxel] = built(context, voxel)
        ours_s[voxel] = (time.perf_counter() - start) / len(context)
    memory = memories[VOXEL]
    volume = open3d_peers.TsdfVolume(TSDF_VOXEL)
    start = time.perf_counter()
    for shot in context:
        volume.integrate(*open3d_peers.images(shot.rgb, shot.depth), shot.camera)
    volume_s = (time.perf_counter() - start) / len(context)
    positions = np.concatenate([_raw_points(s) for s in context])
    colors = np.concatenate([s.rgb[s.depth > 0] for s in context]).astype(np.float32) / 255
    start = time.perf_counter()
    cloud = open3d_peers.cloud(positions, colors).voxel_down_sample(VOXEL)
    cloud_s = (time.perf_counter() - start) / len(context)
    del positions, colors

    def project(voxel: float, camera: Cameras) -> tuple[NDArray[Any], NDArray[Any]]:
        guidance = memories[voxel].project(camera)
        return guidance.rgb[0], guidance.depth[0]

    methods: list[tuple[str, Callable[[Cameras], tuple[Any, Any]], float]] = [
        *(
            (f"ours, {voxel * 1e3:g} mm", partial(project, voxel), ours_s[voxel])
            for voxel in memories
        ),
        (f"TSDF {TSDF_VOXEL * 1e3:g} mm, ray_cast", volume.ray_cast, volume_s),
        (
            f"voxel_down_sample {VOXEL * 1e3:g} mm, project_to_rgbd_image",
            lambda camera: open3d_peers.one_pixel(cloud, camera),
            cloud_s,
        ),
    ]
    rows: list[dict[str, Any]] = []
    for name, method, fuse_s in methods:
        values, covered = [], []
        for target in targets:
            rgb, depth = method(target.camera)
            valid = depth > 0
            values.append(psnr(rgb.astype(np.float64), target.rgb, mask=valid))
            covered.append(float(valid.mean()))
        known = [value for value in values if value is not None]
        rows.append(
            {
                "method": name,
                "psnr_valid": statistics.mean(known),
                "coverage": statistics.mean(covered),
                "fuse_s_per_view": fuse_s,
            }
        )
    calls = [lambda turn, m=method: m(targets[turn].camera) for _, method, _ in methods]  # type: ignore[misc]
    for row, seconds in zip(rows, alternate(calls, len(targets) - 1, steady=True), strict=True):
        row["s_per_view"] = statistics.median(seconds)
        row["s_per_view_min"] = min(seconds)
    for row in rows:
        row["ratio_to_ray_cast"] = row["s_per_view"] / rows[len(memories)]["s_per_view"]
    for row, stored in zip(rows, memories.values(), strict=False):
        row["bytes_per_observation"] = stored.nbytes / len(stored)
        row["observations"], row["voxels"] = len(stored), stored.voxels
    columns = ("method", "psnr_valid", "coverage", "s_per_view", "s_per_view_min",
               "ratio_to_ray_cast", "fuse_s_per_view")  # fmt: skip
    console.table(columns, [[row[column] for column in columns] for row in rows])
    console.line(
        f"{len(memory):,} observations in {memory.voxels:,} voxels, "
        f"{memory.nbytes / len(memory):.1f} bytes each"
    )
    return rows


def _raw_points(shot: Shot) -> NDArray[np.float32]:
    """(N, 3) float32 world points of every pixel with depth, nothing dropped: the peer's input."""
    pose = shot.camera.world_from_cam[0]
    points = shot.camera.rays() * shot.depth[..., None]
    return (points[shot.depth > 0] @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)


def tenfold(
    context: list[Shot], targets: list[Shot], repeat: int, console: Console
) -> dict[str, Any]:
    """Fusing and projecting when nine more copies of the scene lie far away."""
    small, large = built(context, VOXEL), SpatialMemory(VOXEL)
    for shot in context:
        lifted = back_project(shot.rgb, shot.depth, shot.camera)
        for copy in range(COPIES + 1):
            large.fuse(_moved(lifted, copy), round=0)
    fused = alternate(
        [lambda turn, m=memory: _fuse(m, targets[turn]) for memory in (small, large)],  # type: ignore[misc]
        repeat,
    )
    projected = alternate(
        [lambda turn, m=memory: m.project(targets[turn].camera) for memory in (small, large)],  # type: ignore[misc]
        repeat,
        steady=True,
    )
    figures: dict[str, Any] = {"observations": [len(small), len(large)]}
    for name, (one, ten) in (("fuse", fused), ("project", projected)):
        figures[name] = {
            "one_s": statistics.median(one),
            "ten_s": statistics.median(ten),
            "ratio": statistics.median(ten) / statistics.median(one),
            "ratio_of_minima": min(ten) / min(one),
        }
        console.line(
            f"{name}, {len(large):,} observations instead of {len(small):,}: "
            f"{figures[name]['ratio']:.2f} x ({figures[name]['ratio_of_minima']:.2f} x of minima)"
        )
    return figures


def _moved(points: PointSet, copy: int) -> PointSet:
    """The same view of a copy of the scene that lies ``copy`` steps away."""
    if not copy:
        return points
    shift = np.array([copy * APART, 0.0, 0.0])
    pose = points.camera.cam_from_world.copy()
    pose[0, :3, 3] -= pose[0, :3, :3] @ shift
    camera = replace(points.camera, cam_from_world=pose)
    positions = (points.positions + shift).astype(np.float32)
    return replace(points, positions=positions, camera=camera)


def _fuse(memory: SpatialMemory, shot: Shot) -> None:
    memory.observe(shot.rgb, shot.depth, shot.camera, round=1)


def sweep(context: list[Shot], targets: list[Shot], console: Console) -> list[dict[str, Any]]:
    """What the memory's options buy, one changed at a time."""
    plain = MemoryOptions()
    settings: list[tuple[str, float, MemoryOptions]] = [("default", VOXEL, plain)]
    for count in (1, 2, 4, 64):
        settings.append(
            (f"observations_per_voxel {count}", VOXEL, plain.replaced(observations_per_voxel=count))
        )
    for degrees in (0.0, 5.0, 15.0):
        settings.append(
            (f"merge_angle_deg {degrees:g}", VOXEL, plain.replaced(merge_angle_deg=degrees))
        )
    for voxel in (0.0035, 0.01, 0.02):
        settings.append((f"voxel {voxel * 1e3:g} mm", voxel, plain))
    rows = []
    for name, voxel, options in settings:
        start = time.perf_counter()
        memory = built(context, voxel, options)
        fuse_s = (time.perf_counter() - start) / len(context)
        values, covered, seconds = [], [], []
        for target in targets:
            start = time.perf_counter()
            guidance = memory.project(target.camera)
            seconds.append(time.perf_counter() - start)
            values.append(psnr(guidance.rgb[0], target.rgb, mask=guidance.valid[0]))
            covered.append(guidance.coverage)
        row = {
            "setting": name,
            "psnr_valid": statistics.mean(value for value in values if value is not None),
            "coverage": statistics.mean(covered),
            "observations": len(memory),
            "voxels": memory.voxels,
            "MiB": memory.nbytes / 2**20,
            "fuse_s": fuse_s,
            "project_s": statistics.median(seconds),
        }
        rows.append(row)
    console.table(list(rows[0]), [list(row.values()) for row in rows])
    return rows


if __name__ == "__main__":
    main()
