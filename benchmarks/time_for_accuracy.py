"""What more time buys: held-out pictures after 15 s to 7 min of fitting, beside plain splatting.

    python benchmarks/time_for_accuracy.py SHARED OUT [--scenes "fox;fern, 3 views"] [--no-peer]

SHARED is the folder of real scenes; its ``tools/peer_gaussians`` is plain 3D Gaussian splatting,
which is run right after gvtools for the same processor time. Seconds are of the processor, of all
cores together, from the command's start to its pictures. Kept in OUT: runs, ``table.md`` and
``front.png``; rows that are there already are not measured again.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

# Scenes side by side in the plot.
ACROSS = 4


@dataclass(frozen=True)
class Case:
    """A scene with its split and the seconds of processor time to try.

    Attributes:
        project: below SHARED/data; a sample of ``gvtools demo`` where it has no folder.
        context: the views that are given.
        targets: those that are held out.
        budgets: seconds of processor time that a whole run may take.
        own: start from the sparse points alone that two views of the context detected.
    """

    project: str
    context: str
    targets: str
    budgets: tuple[int, ...]
    own: bool = False


CASES = {
    "fox": Case("fox_colmap", "not:every:8", "every:8", (60, 140, 420)),
    "fern": Case("fern_colmap", "not:every:8", "every:8", (40, 95, 250)),
    "fox, 7 views": Case("fox_colmap", "every:8", "every:8+4", (30, 100)),
    "fern, 3 views": Case("fern_colmap", "every:8", "every:8+4", (30, 90)),
    "fox, 3 views": Case("fox_colmap", "0012.jpg,0044.jpg,0090.jpg", "every:8+4", (30, 90)),
    "fox, 7 views, own points": Case("fox_colmap", "every:8", "every:8+4", (30, 100), own=True),
    "fern, 3 views, own points": Case("fern_colmap", "every:8", "every:8+4", (30, 90), own=True),
    "fox, 3 views, own points": Case(
        "fox_colmap", "0012.jpg,0044.jpg,0090.jpg", "every:8+4", (30, 90), own=True
    ),
    "kitchen": Case("sevenscenes_reg", "every:2", "every:2+1", (60, 300)),
    "demo room": Case("room", "first:8", "not:first:8", (30, 60)),
    "noisy room": Case("noisy-room", "first:8", "not:first:8", (30, 60)),
}


def main() -> None:
    """Measure what is missing, then write the table and the plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", default=";".join(CASES))
    parser.add_argument("--no-peer", action="store_true")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, case in CASES.items():
        if name not in args.scenes.split(";"):
            continue
        project = _project(case, args.shared, args.out)
        for budget in (0, *case.budgets):
            stem = f"{name} {budget}".replace(",", "").replace(" ", "_")
            run = partial(_run, case, project, budget, args.out)
            ours = _kept(args.out / f"{stem}.json", run)
            rows.append({"scene": name, "method": "gvtools", "budget": budget, **ours})
            peer = args.shared / "tools" / "peer_gaussians" / "train.py"
            if budget and not args.no_peer and peer.exists():
                rival = partial(_peer, case, project, budget, peer, args.out)
                found = _kept(args.out / f"{stem}_peer.json", rival)
                rows.append({"scene": name, "method": "splatting", "budget": budget, **found})
            _write(rows, args.out)


def _kept(path: Path, measure: Any) -> dict[str, Any]:
    """What a file holds, or what is measured and written there."""
    if not path.exists():
        path.write_text(json.dumps(measure()))
    return json.loads(path.read_text())


def _project(case: Case, shared: Path, out: Path) -> Path:
    folder = shared / "data" / case.project
    if folder.is_dir():
        return folder
    sample = out / f"{case.project}-sample"
    if not sample.exists():
        words = ["demo", "--sample", case.project, "--out", str(out / case.project), "--dry-run"]
        subprocess.run([sys.executable, "-m", "pipelines.cli", *words], check=True)
    return sample


def _seconds(command: list[str]) -> float:
    """Processor seconds of a command and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _run(case: Case, project: Path, budget: int, out: Path) -> dict[str, Any]:
    """Run gvtools; the seconds of fitting are what a run without it leaves of the budget."""
    stem = f"{case.project}-{case.context}-{'own-' * case.own}{budget}".replace(":", "")
    command = [sys.executable, "-m", "pipelines.cli", "reconstruct", str(project), "--quiet"]
    command += ["--context", case.context, "--targets", case.targets, "--out", str(out / stem)]
    command += ["--set", f"points={'context' if case.own else 'all'}"]
    refine = 0.0
    if budget:
        # What the rest of a run takes, about: views with recorded depth have their poses refined.
        views, recorded = len(_selected(project, case.context)), _has_depth(project)
        rest = 6.0 + 0.9 * views if recorded else 9.0 + 0.2 * views
        # A fit keeps 1.75 cores busy.
        refine = max(budget - rest, 5.0) / 1.75
    seconds = _seconds([*command, "--refine", f"{refine:g}"])
    figures = json.loads((out / stem / "metrics.json").read_text())
    appearance = out / stem / "round_000" / "appearance.npz"
    count = figures["observations"]
    if appearance.exists():
        with np.load(appearance, allow_pickle=False) as data:
            count = len(data["values"])
    kept = appearance if appearance.exists() else out / stem / "memory.npz"
    return {
        "seconds": seconds,
        "psnr": figures["psnr"],
        "ssim": figures["ssim"],
        "psnr_observed": figures["psnr_valid"],
        "coverage": figures["coverage"],
        "primitives": count,
        "megabytes": kept.stat().st_size / 1e6,
    }


def _selected(project: Path, spec: str) -> list[int]:
    from gvtools import open_project
    from gvtools.scenes.selection import select

    names = open_project(project).names
    return [names.index(name) for name in select(names, spec)]


def _has_depth(project: Path) -> bool:
    from gvtools import open_project

    scene = open_project(project)
    return bool(scene[scene.names[0]].has_depth)


def _peer(case: Case, project: Path, budget: int, train: Path, out: Path) -> dict[str, Any]:
    """Run plain splatting on the same split for the same processor time."""
    from gvtools import open_project
    from gvtools.scenes.resized import seen_by

    scene = open_project(project)
    if case.own:
        scene = seen_by(scene, [scene.names[row] for row in _selected(project, case.context)])
    given, held_out = _selected(project, case.context), _selected(project, case.targets)
    frames = {row: scene[scene.names[row]].load() for row in {*given, *held_out}}
    cameras = scene.cameras
    arrays = {f"im{row}": frame.rgb for row, frame in frames.items()}
    if scene.points is not None:
        points, colors = scene.points.positions, scene.points.colors
    else:
        points, colors = _lifted(frames, given, cameras)
    file = out / "peer.npz"
    np.savez(
        file, K=cameras.K, w2c=cameras.cam_from_world, names=np.array(scene.names),
        train=given, test=held_out, points=points.astype(np.float32), colors=colors, **arrays,
    )  # fmt: skip
    result = out / "peer"
    command = [sys.executable, str(train), str(file), str(result), "--budget", str(budget)]
    seconds = _seconds([*command, "--cpu-clock"])
    last = json.loads(result.with_suffix(".json").read_text())["hist"][-1]
    size = result.with_suffix(".ply").stat().st_size / 1e6
    return {
        "seconds": seconds, "psnr": last["psnr"], "ssim": last["ssim"], "primitives": last["N"],
        "megabytes": size, "psnr_observed": None, "coverage": None,
    }  # fmt: skip


def _lifted(frames: Any, rows: list[int], cameras: Any) -> tuple[np.ndarray, np.ndarray]:
    """Some 60,000 pixels with recorded depth as points."""
    rng, points, colors = np.random.default_rng(0), [], []
    for row in rows:
        depth = frames[row].depth
        y, x = np.nonzero(depth > 0)
        picked = rng.permutation(len(y))[: 60_000 // len(rows)]
        y, x = y[picked], x[picked]
        rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]).T @ np.linalg.inv(cameras.K[row]).T
        pose = cameras.cam_from_world[row]
        points.append((rays * depth[y, x, None] - pose[:3, 3]) @ pose[:3, :3])
        colors.append(frames[row].rgb[y, x])
    return np.concatenate(points), np.concatenate(colors)


def _write(rows: list[dict[str, Any]], out: Path) -> None:
    import matplotlib.pyplot as plt

    names = ["scene", "method", "CPU s", "PSNR", "SSIM", "primitives", "MB"]
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for row in rows:
        lines.append(
            f"| {row['scene']} | {row['method']} | {row['seconds']:.0f} | {row['psnr']:.2f} | "
            f"{row['ssim']:.3f} | {row['primitives']:,} | {row['megabytes']:.1f} |"
        )
    (out / "table.md").write_text("\n".join(lines) + "\n")
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    lines_of_axes = -(-len(scenes) // ACROSS)
    size = 3.2 * ACROSS, 2.7 * lines_of_axes + 0.4
    figure, axes = plt.subplots(lines_of_axes, ACROSS, figsize=size, squeeze=False)
    for axis in axes.ravel()[len(scenes) :]:
        axis.set_axis_off()
    for axis, scene in zip(axes.ravel(), scenes, strict=False):
        for method, label in (("gvtools", "gvtools"), ("splatting", "plain Gaussian splatting")):
            mine = [row for row in rows if (row["scene"], row["method"]) == (scene, method)]
            shown = [row for row in mine if row["budget"]]
            axis.plot([r["seconds"] for r in shown], [r["psnr"] for r in shown], "o-", label=label)
            alone = [row for row in mine if not row["budget"]]
            for row in alone:
                axis.plot(row["seconds"], row["psnr"], "kx", label="gvtools, the memory alone")
        axis.set_xscale("log")
        axis.set_xticks([10, 30, 100, 300], ["10", "30", "100", "300"])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.set_title(scene.replace(" views", " photographs"), fontsize=9)
        axis.set_xlabel("processor time [s]", fontsize=8)
        axis.set_ylabel("PSNR [dB]", fontsize=8)
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="lower center", ncols=3, fontsize=9)
    figure.savefig(out / "front.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
