"""Depth from photographs: accuracy against time, and how far the confidence can be believed.

    python -m benchmarks.stereo SEVENSCENES_FOLDER [--views 10] [--every 2] [--plot FILE]

The scenes are the procedural room, whose depth is exact, and a 7-Scenes folder with registered
depth, of which stereo gets the pictures and poses alone. ``kept`` is the share of pixels with true
depth that get one, ``median`` the median relative error of those, ``off`` the share that is wrong
by more than 10 %. Seconds are of whole depth maps, sources' own estimates included, over the views
that were computed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.reliability import Reliability, reliability
from gvtools.depth.options import StereoOptions
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.procedural.room_sample import write_room
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Scene
from gvtools.scenes.selection import select

SETTINGS = {
    "320 px, 2 sources": StereoOptions(max_side=320, sources=2, best=1),
    "320 px, 4 sources": StereoOptions(max_side=320),
    "640 px, 2 sources": StereoOptions(sources=2, best=1),
    "640 px, 4 sources (default)": StereoOptions(),
    "640 px, 4 sources, 32 planes": StereoOptions(planes=32),
    "640 px, 4 sources, 2 iterations": StereoOptions(iterations=2),
}
WRONG = 0.05  # relative error above which a pixel is wrong, for the reliability


def measure(scene: Scene, pool: tuple[str, ...], views: list[str], options: StereoOptions) -> dict:
    """Accuracy over some views, with the pool as sources."""
    stereo = PlaneSweepStereo(scene, options=options, views=pool)
    start = time.perf_counter()
    _ = stereo.cameras  # adjusts the poses, where that is done
    posing = time.perf_counter() - start
    kept, medians, off, confidences, right = [], [], [], [], []
    start = time.perf_counter()
    for name in views:
        frame = scene[name].load()
        assert frame.depth is not None
        found = stereo.depth(scene, scene[name], frame)
        true = frame.depth > 0
        both = true & (found.depth > 0)
        error = np.abs(found.depth[both] / frame.depth[both] - 1)
        kept.append(both.sum() / true.sum())
        medians.append(float(np.median(error)))
        off.append(float((error > 0.1).mean()))
        confidences.append(found.confidence[both])
        right.append(error < WRONG)
    seconds = (time.perf_counter() - start) / len(stereo.computed)
    return {
        "kept": float(np.mean(kept)),
        "median": float(np.mean(medians)),
        "off": float(np.mean(off)),
        "seconds": seconds,
        "posing": posing / len(pool),
        "reliability": reliability(np.concatenate(confidences), np.concatenate(right)),
    }


def draw(diagrams: dict[str, Reliability], path: Path) -> None:
    """The reliability diagram: share of right depths over what their confidence claims."""
    from matplotlib.figure import Figure

    axes = (figure := Figure(figsize=(5, 5), layout="constrained")).subplots()
    axes.plot([0, 1], [0, 1], color="0.7")
    for name, data in diagrams.items():
        axes.plot(data.predicted, data.observed, "o-", label=name)
    axes.set(xlabel="confidence", ylabel=f"share within {WRONG:.0%} of the true depth")
    axes.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Both scenes, all settings; the reliability diagram's data of the default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--every", type=int, default=2)
    parser.add_argument("--plot", type=Path, help="reliability diagram, PNG")
    args = parser.parse_args()
    diagrams: dict[str, Reliability] = {}
    with tempfile.TemporaryDirectory() as folder:
        write_room(Path(folder) / "room")
        kitchen = open_project(args.folder)
        scenes = {
            "room": (open_project(Path(folder) / "room"), "all"),
            "7-Scenes": (kitchen, f"every:{args.every}"),
        }
        for label, options in SETTINGS.items():
            for name, (scene, spec) in scenes.items():
                pool = select(scene.names, spec)
                views = [pool[i] for i in np.linspace(0, len(pool) - 1, args.views).astype(int)]
                found = measure(scene, pool, views, options)
                print(
                    f"{label:32} {name:9} kept {found['kept']:.1%}  median {found['median']:.2%}  "
                    f"off {found['off']:.1%}  {found['seconds']:.2f} s a view "
                    f"(+ {found['posing']:.2f} s for poses)",
                    flush=True,
                )
                if options == StereoOptions():
                    diagrams[name] = found["reliability"]
                    print(f"  confidence is off by {found['reliability'].error:.3f} on average")
    if args.plot is not None:
        draw(diagrams, args.plot)


if __name__ == "__main__":
    main()
