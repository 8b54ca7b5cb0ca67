"""Photographs alone: a memory from computed depth, against COLMAP's sparse points.

    python benchmarks/photographs.py PROJECT [PROJECT ...]

Every eighth photograph of each COLMAP project is held out and nothing of it is looked at. Depth of
the others is computed, lifted and fused; the held-out cameras are projected without a completer.
The peer is the project's sparse cloud (those points that the context sees) through the same
splatter, at the footprint that gives it the best picture. PSNR is on valid pixels; "whole" counts
holes as black.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np

from gvtools.depth.choice import choose_source
from gvtools.depth.stereo.options import StereoOptions
from gvtools.evaluation.images import psnr
from gvtools.memory.back_projection import back_project
from gvtools.memory.points import PointSet
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Scene
from gvtools.scenes.selection import select
from pipelines.plan import automatic_voxel

FOOTPRINTS = (2, 4, 8, 16, 32)  # pixels across


def quality(memory: SpatialMemory, scene: Scene, names: tuple[str, ...]) -> tuple[float, ...]:
    """Mean PSNR on valid pixels, mean coverage, mean PSNR with black holes."""
    known, covered, whole = [], [], []
    for name in names:
        frame = scene[name].load()
        guidance = memory.project(scene[name].camera)
        use = np.ones(frame.rgb.shape[:2], bool) if frame.mask is None else frame.mask
        valid = guidance.valid[0]
        value = psnr(guidance.rgb[0], frame.rgb, mask=valid & use)
        if value is not None:
            known.append(value)
        covered.append(float(valid[use].mean()))
        whole.append(psnr(guidance.rgb[0], frame.rgb, mask=use) or 0.0)
    return statistics.mean(known) if known else 0.0, *map(statistics.mean, (covered, whole))


def from_depth(scene: Scene, context: tuple[str, ...], options: StereoOptions) -> tuple:
    """The memory of computed depth, and the seconds a view."""
    chosen = choose_source(scene, context, "plane-sweep", stereo=options)
    voxel = automatic_voxel(scene, context, chosen.source, percentile=50)
    memory = SpatialMemory(voxel, origin=np.rint(scene.cameras.centers.mean(axis=0)))
    start = time.perf_counter()
    for name in context:
        frame = scene[name].load()
        found = chosen.source.depth(scene, scene[name], frame)
        points = back_project(
            frame.rgb,
            found.depth,
            scene[name].camera,
            origin=memory.origin,
            confidence=found.confidence,
            mask=frame.mask,
        )
        memory.fuse(points, round=0)
    return memory, (time.perf_counter() - start) / len(context)


def from_sparse(scene: Scene, context: tuple[str, ...], footprint: float) -> SpatialMemory:
    """The sparse points that the context sees, each as wide as ``footprint`` pixels."""
    points = scene.points
    assert points is not None
    rows = {scene.names.index(name) for name in context}
    seen = np.isin(points.view_index, list(rows))
    origin = np.rint(scene.cameras.centers.mean(axis=0))
    kept = np.unique(points.point_index[seen])
    camera = scene[context[len(context) // 2]].camera
    depth = np.abs(np.linalg.norm(points.positions[kept] - camera.centers[0], axis=1))
    spacing = footprint * depth / np.sqrt(camera.K[0, 0, 0] * camera.K[0, 1, 1])
    memory = SpatialMemory(float(np.median(spacing)) / footprint, origin=origin)
    count = len(kept)
    memory.fuse(
        PointSet(
            positions=(points.positions[kept] - origin).astype(np.float32),
            colors=points.colors[kept],
            confidence=np.ones(count, np.float32),
            spacing=spacing.astype(np.float32),
            origin=origin,
            camera=camera,
            free_depth=None,
            dropped={},
        ),
        round=0,
    )
    return memory


def main() -> None:
    """Measure each project."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("projects", type=Path, nargs="+")
    args = parser.parse_args()
    print("project  method  PSNR dB  coverage %  whole dB  s/view")
    for path in args.projects:
        scene = open_project(path)
        held_out = select(scene.names, "every:8")
        context = select(scene.names, "not:every:8")
        best = max(
            (quality(from_sparse(scene, context, width), scene, held_out), width)
            for width in FOOTPRINTS
        )
        by_whole = max(
            ((quality(from_sparse(scene, context, width), scene, held_out), width)
             for width in FOOTPRINTS),
            key=lambda found: found[0][2],
        )  # fmt: skip
        for label, (figures, width) in (("best on valid", best), ("best whole", by_whole)):
            known, covered, whole = figures
            print(f"{path.name}  sparse, {width} px ({label})  {known:.2f}  {100 * covered:.1f}  "
                  f"{whole:.2f}  -")  # fmt: skip
        memory, seconds = from_depth(scene, context, StereoOptions())
        known, covered, whole = quality(memory, scene, held_out)
        print(f"{path.name}  computed depth  {known:.2f}  {100 * covered:.1f}  {whole:.2f}  "
              f"{seconds:.2f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
