"""What measuring costs beside rendering: all figures of a view against projecting it twice.

    python benchmarks/metrics.py FOLDER [--views 100]

FOLDER is a 7-Scenes folder with registered depth. Every second view is fused; the views are then
projected and measured in turns, in one process.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

from gvtools.evaluation.images import view_figures
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.scenes.project import open_project


def main() -> None:
    """Fuse, then project and measure each view."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--voxel", type=float, default=0.005)
    args = parser.parse_args()
    scene = open_project(args.folder)
    memory = SpatialMemory(args.voxel)
    for view in scene.views[::2]:
        frame = view.load()
        assert frame.depth is not None
        memory.observe(frame.rgb, frame.depth, view.camera, round=0, mask=frame.mask)
    rendering, measuring = [], []
    for view in (scene.views[0], *scene.views[: args.views]):
        frame = view.load()
        start = time.perf_counter()
        for _ in range(2):
            guidance = memory.project(view.camera)
        middle = time.perf_counter()
        view_figures(
            guidance.rgb[0],
            frame,
            observed=guidance.valid[0],
            generated=~guidance.valid[0],
            depth=guidance.depth[0],
        )
        measuring.append(time.perf_counter() - middle)
        rendering.append(middle - start)
    # The first view compiled or loaded the kernels.
    twice, figures = sum(rendering[1:]), sum(measuring[1:])
    size = f"{frame.rgb.shape[1]}x{frame.rgb.shape[0]}"
    medians = [statistics.median(times[1:]) for times in (rendering, measuring)]
    print(f"{len(rendering) - 1} views of {size}, voxel {args.voxel}")
    print(f"projecting them twice  {twice:.2f} s (median {medians[0]:.4f} a view)")
    print(f"all their figures      {figures:.2f} s (median {medians[1]:.4f} a view)")
    print(
        f"ratio                  {figures / twice:.2f} (of medians {medians[1] / medians[0]:.2f})"
    )


if __name__ == "__main__":
    main()
