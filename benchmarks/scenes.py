"""The scene set: held-out pictures of every kind of capture, after 30 to 400 s, beside peers.

    python -m benchmarks.scenes SHARED OUT [--half a] [--clocks "no fit,60"] [--no-peer]

SHARED is the folder of real scenes; its ``tools/peer_gaussians`` is plain 3D Gaussian splatting,
which is run right after gvtools for the same processor time. Half ``a`` of the scenes chooses
defaults, half ``b`` only judges. Seconds are of the processor, of all cores together, from the
command's start to its pictures. Kept in OUT: scenes, runs, ``table.md`` and ``front.png``; rows
that are there already are not measured again.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.made_scenes import PLACES, write_place

# Scenes side by side in the plot.
ACROSS = 4
GVTOOLS = (sys.executable, "-m", "pipelines.cli")
# Processor seconds of a whole run by the clock's name; "default" says nothing of time.
CLOCKS = {"no fit": 0, "default": None, "30": 30, "60": 60, "140": 140, "400": 400}


@dataclass(frozen=True)
class Case:
    """A scene with its split.

    Attributes:
        half: "a" or "b".
        project: below SHARED/data, in PLACES, or a sample of ``gvtools demo``.
        context: the views that are given.
        targets: those that are held out.
        capture: whether its cameras are found first.
        settings: of the run.
    """

    half: str
    project: str
    context: str
    targets: str
    capture: bool = False
    settings: tuple[str, ...] = ()


CASES = {
    "lego (orbit)": Case("a", "lego_colmap", "not:every:8", "every:8"),
    "fern, 3 views": Case("a", "fern_colmap", "every:8", "every:8+4"),
    "fox": Case("a", "fox_colmap", "not:every:8", "every:8"),
    "kermit (orbit, few)": Case("a", "kermit_photographs", "not:every:4", "every:4", capture=True),
    "kitchen, RGB-D": Case("a", "sevenscenes_reg", "every:2", "every:2+1"),
    "object outdoors": Case("a", "object outdoors", "not:every:8", "every:8"),
    "facade": Case("a", "facade", "not:every:6", "every:6"),
    "corridor": Case("a", "corridor", "not:every:6", "every:6"),
    "from above, noisy": Case("a", "from above, noisy", "not:every:6", "every:6"),
    "room inside, 200": Case("a", "room inside, 200", "not:every:8", "every:8"),
    "fox, 1600 pixels": Case("a", "fox_transforms", "not:every:8", "every:8"),
    "fern": Case("b", "fern_colmap", "not:every:8", "every:8"),
    "fox, 7 views": Case("b", "fox_colmap", "every:8", "every:8+4"),
    "sceaux (far background)": Case("b", "sceaux_colmap", "not:every:4", "every:4"),
    "internet facade": Case("b", "internet_facade", "not:every:4", "every:4", capture=True),
    "kitchen, photographs": Case(
        "b", "sevenscenes_reg", "every:4", "every:4+2", settings=("depth=plane-sweep",)
    ),
    "object indoors": Case("b", "object indoors", "not:every:8", "every:8"),
    "object, noisy": Case("b", "object, noisy", "not:every:8", "every:8"),
    "object, close": Case("b", "object, close", "not:every:4", "every:4"),
    "facade, exposed": Case("b", "facade, exposed", "not:every:6", "every:6"),
    "street": Case("b", "street", "not:every:6", "every:6"),
    "from above": Case("b", "from above", "not:every:6", "every:6"),
    "street, 1600 pixels": Case("b", "street, 1600 pixels", "not:every:6", "every:6"),
    "corridor, 240 pixels": Case("b", "corridor, 240 pixels", "not:every:6", "every:6"),
    "plant": Case("b", "plant", "not:every:6", "every:6"),
    "plant, few": Case("b", "plant, few", "not:every:4", "every:4"),
    "facade, 960 pixels": Case("b", "facade, 960 pixels", "not:every:6", "every:6"),
    "object indoors, 1280 pixels": Case(
        "b", "object indoors, 1280 pixels", "not:every:8", "every:8"
    ),
    "room inside": Case("b", "room inside", "not:every:6", "every:6"),
    "demo room": Case("b", "room", "first:8", "not:first:8"),
}


def main() -> None:
    """Measure what is missing, then write the table and the plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", help='names, such as "fox;facade"')
    parser.add_argument("--half", choices=("a", "b"))
    parser.add_argument("--clocks", default="no fit,default,60", help=", ".join(CLOCKS))
    parser.add_argument("--no-peer", action="store_true")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, case in CASES.items():
        if args.scenes and name not in args.scenes.split(";"):
            continue
        if args.half not in (None, case.half):
            continue
        project = _project(case, args.shared, args.out)
        for clock in args.clocks.split(","):
            stem = f"{name} {clock}".replace(",", "").replace(" ", "_")
            run = partial(_run, case, project, clock, args.out / stem)
            ours = _kept(args.out / f"{stem}.json", run)
            rows.append({"scene": name, "method": "gvtools", "clock": clock, **ours})
            peer = args.shared / "tools" / "peer_gaussians" / "train.py"
            without = args.no_peer or name == "fox, 1600 pixels"  # no points to begin with
            if CLOCKS[clock] and not without and peer.exists():
                rival = partial(_peer, case, project, CLOCKS[clock], peer, args.out)
                found = _kept(args.out / f"{stem}_peer.json", rival)
                rows.append({"scene": name, "method": "splatting", "clock": clock, **found})
            _write(rows, args.out)


def _kept(path: Path, measure: Any) -> dict[str, Any]:
    """What a file holds, or what is measured and written there."""
    if not path.exists():
        path.write_text(json.dumps(measure()))
    return json.loads(path.read_text())


def _project(case: Case, shared: Path, out: Path) -> Path:
    place = out / case.project.replace(",", "").replace(" ", "-")
    if case.project in PLACES:
        if not place.exists():
            write_place(place, PLACES[case.project])
        return place
    folder = shared / "data" / case.project
    if case.capture:
        if not place.exists():
            _seconds([*GVTOOLS, "capture", str(folder), "--out", str(place), "--quiet"])
        return place
    if folder.is_dir():
        return folder
    sample = out / f"{case.project}-sample"
    if not sample.exists():
        words = ["demo", "--sample", case.project, "--out", str(out / case.project), "--dry-run"]
        _seconds([*GVTOOLS, *words])
    return sample


def _seconds(command: list[str]) -> float:
    """Processor seconds of a command and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _run(case: Case, project: Path, clock: str, out: Path) -> dict[str, Any]:
    """Run gvtools; the seconds of fitting are what a run without it leaves of the budget."""
    shutil.rmtree(out, ignore_errors=True)
    command = [*GVTOOLS, "reconstruct", str(project), "--quiet", "--out", str(out)]
    command += ["--context", case.context, "--targets", case.targets]
    command += [word for text in case.settings for word in ("--set", text)]
    budget = CLOCKS[clock]
    if budget == 0:
        command += ["--refine", "0"]
    elif budget:
        # What the rest of a run takes, about: views with recorded depth have their poses refined.
        views, recorded = len(_selected(project, case.context)), _has_depth(project)
        rest = 4.0 + 0.8 * views if recorded else 8.0 + 0.17 * views
        # A fit keeps 1.65 cores busy.
        command += ["--refine", f"{max(budget - rest, 5.0) / 1.65:g}"]
    seconds = _seconds(command)
    figures = json.loads((out / "metrics.json").read_text())
    appearance = out / "round_000" / "appearance.npz"
    count = figures["observations"]
    if appearance.exists():
        with np.load(appearance, allow_pickle=False) as data:
            count = len(data["values"])
    kept = appearance if appearance.exists() else out / "memory.npz"
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


def _peer(case: Case, project: Path, budget: int | None, train: Path, out: Path) -> dict[str, Any]:
    """Run plain splatting on the same split for the same processor time."""
    from gvtools import open_project

    scene = open_project(project)
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

    names = ["scene", "method", "clock", "CPU s", "PSNR", "SSIM", "primitives", "MB"]
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for row in rows:
        lines.append(
            f"| {row['scene']} | {row['method']} | {row['clock']} | {row['seconds']:.0f} | "
            f"{row['psnr']:.2f} | {row['ssim']:.3f} | {row['primitives']:,} | "
            f"{row['megabytes']:.1f} |"
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
            shown = [row for row in mine if row["clock"] != "no fit"]
            axis.plot([r["seconds"] for r in shown], [r["psnr"] for r in shown], "o-", label=label)
            alone = [row for row in mine if row["clock"] == "no fit"]
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
