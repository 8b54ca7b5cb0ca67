"""Four methods judged side by side on a posed RGB-D recording: the table of docs/judge.md.

    python -m benchmarks.judge SHARED OUT

SHARED is the folder of real scenes; its ``tools/peer_gaussians`` is plain 3D Gaussian splatting.
Open3D's TSDF and points are called as its tutorials do. Every second frame is context, the frames
between are targets. gvtools refines the recorded poses; the others are measured at the recorded
ones, and splatting and the TSDF at gvtools' as well; poses are judged at both. gvtools fits for 60
seconds, splatting trains for 120 seconds of processor time, which is two cores for as long. Kept in
OUT: runs, pictures and judgements; runs and pictures that are there already are not made again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from benchmarks.scenes import _lifted

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene, View

PROJECT = "sevenscenes_reg"
CONTEXT, TARGETS = "every:2", "every:2+1"
FIT_SECONDS, PEER_SECONDS = 60, 120  # of the clock, and of the processor
TSDF_VOXEL = 0.01  # metres
POINT_VOXEL = 0.005


def main() -> None:
    """Make what is missing, then judge it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    run = args.out / "gvtools"
    project = args.shared / "data" / PROJECT
    _reconstruct(project, run)
    train = args.shared / "tools" / "peer_gaussians" / "train.py"
    methods = {"gvtools": run}
    for poses in ("recorded", "refined"):
        context, targets = _views(run, refined=poses == "refined")
        mark = "" if poses == "recorded" else ", refined poses"
        made = args.out / poses
        methods[f"3D Gaussians{mark}"] = _splatted(context, targets, made, train)
        methods[f"Open3D TSDF{mark}"] = _integrated(context, targets, made / "tsdf")
        if poses == "recorded":
            methods["Open3D points"] = _projected(context, targets, made / "points")
    _judge(methods, str(run), "--out", str(args.out / "judged"))
    recorded = {name: path for name, path in methods.items() if "refined" not in name}
    split = ("--context", CONTEXT, "--targets", TARGETS, "--parts", "images,poses")
    _judge(recorded, str(project), *split, "--out", str(args.out / "judged_recorded"))


def _judge(methods: dict[str, Path], against: str, *options: str) -> None:
    words = [str(path) for path in methods.values()]
    for name in methods:
        words += ["--name", name]
    command = [sys.executable, "-m", "pipelines.cli", "judge", *words, "--against", against]
    subprocess.run([*command, *options], check=True)


def _reconstruct(project: Path, run: Path) -> None:
    if not run.exists():
        words = ["reconstruct", str(project), "--context", CONTEXT, "--targets", TARGETS]
        words += ["--refine", str(FIT_SECONDS), "--out", str(run), "--quiet"]
        subprocess.run([sys.executable, "-m", "pipelines.cli", *words], check=True)


def _views(run: Path, *, refined: bool) -> tuple[list[View], list[View]]:
    """Context and targets at the run's poses or at the recorded ones."""
    from gvtools import open_project
    from gvtools.runs.run import load_run

    loaded = load_run(run)
    scenes: tuple[Scene, Any] = loaded.scenes
    if not refined:
        project = open_project(loaded.record["project"])
        scenes = project, project
    names = [view.name for view in loaded.views]
    return [scenes[0][name] for name in loaded.context], [scenes[1][name] for name in names]


def _splatted(context: list[View], targets: list[View], out: Path, train: Path) -> Path:
    """Plain Gaussian splatting on the context; its pictures of the targets."""
    folder = out / "gaussians"
    if _made(folder, targets):
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    views = [*context, *targets]
    frames = {row: view.load() for row, view in enumerate(views)}
    given = list(range(len(context)))
    cameras = _cameras(views)
    points, colors = _lifted(frames, given, cameras)
    np.savez(
        out / "peer.npz", K=cameras.K, w2c=cameras.cam_from_world,
        names=np.array([view.name for view in views]), train=given,
        test=list(range(len(context), len(views))), points=points.astype(np.float32),
        colors=colors, **{f"im{row}": frame.rgb for row, frame in frames.items()},
    )  # fmt: skip
    command = [sys.executable, str(train), str(out / "peer.npz"), str(folder / "3dgs")]
    subprocess.run([*command, "--budget", f"{PEER_SECONDS:g}", "--cpu-clock"], check=True)
    return folder


def _made(folder: Path, targets: list[View]) -> bool:
    return len(list(folder.glob("*.png"))) == len(targets)


def _cameras(views: list[View]) -> Any:
    from gvtools.cameras import concatenate

    return concatenate([view.camera for view in views])


def _integrated(context: list[View], targets: list[View], folder: Path) -> Path:
    """Open3D's TSDF volume; its ray-cast pictures of the targets."""
    from pipelines.bench.open3d_peers import TsdfVolume, images

    if _made(folder, targets):
        return folder
    volume = TsdfVolume(TSDF_VOXEL)
    for view in context:
        frame = view.load()
        volume.integrate(*images(frame.rgb, frame.depth), view.camera)
    for view in targets:
        _write(folder, view.name, *volume.ray_cast(view.camera))
    return folder


def _projected(context: list[View], targets: list[View], folder: Path) -> Path:
    """Open3D's point cloud, one point a voxel; its projections into the targets."""
    from pipelines.bench.open3d_peers import cloud, one_pixel

    if _made(folder, targets):
        return folder
    positions, colors = [], []
    for view in context:
        frame, pose = view.load(), view.camera.world_from_cam[0]
        assert frame.depth is not None
        known = frame.depth > 0
        seen = (view.camera.rays() * frame.depth[..., None])[known]
        positions.append((seen @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
        colors.append(frame.rgb[known].astype(np.float32) / 255)
    points = cloud(np.concatenate(positions), np.concatenate(colors)).voxel_down_sample(POINT_VOXEL)
    for view in targets:
        _write(folder, view.name, *one_pixel(points, view.camera))
    return folder


def _write(folder: Path, name: str, rgb: Any, depth: Any) -> None:
    """One picture with its depth; holes are black."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = Path(name).stem
    pixels = np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(folder / f"{stem}.png")
    np.savez_compressed(folder / f"{stem}.depth.npz", depth=np.asarray(depth, np.float32))


if __name__ == "__main__":
    main()
