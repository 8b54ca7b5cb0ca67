"""Photographs alone: a memory from computed depth, against COLMAP's sparse points.

    python -m benchmarks.photographs PROJECT [PROJECT ...] [--variants]

Every eighth photograph of each COLMAP project is held out and nothing of it is looked at. Depth of
the others is computed, lifted and fused; the held-out cameras are projected without a completer.
The peer is the project's sparse cloud (those points that the context sees) through the same
splatter, at each of several footprints. PSNR is on valid pixels; "whole" counts holes as black.
With "one exposure" the photographs' colours are brought to a common exposure before they are fused,
and what is projected to that of the nearest context views; the held-out picture is not asked.
``--variants`` also measures without what the defaults add.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np

from benchmarks.exposures import Exposures, estimate_exposures
from gvtools.depth.choice import choose_source
from gvtools.depth.options import StereoOptions
from gvtools.depth.source import DepthMap
from gvtools.evaluation.images import psnr
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.store.views import PointSet
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Scene
from gvtools.scenes.selection import select
from pipelines.reconstruction.voxel import automatic_voxel

FOOTPRINTS = (2, 4, 6, 8, 12, 16, 24, 32)  # pixels across
VARIANTS = {
    "neither": StereoOptions(trim=False, regrow=0),
    "trimmed alone": StereoOptions(regrow=0),
    "regrown alone": StereoOptions(trim=False),
}


def quality(
    memory: SpatialMemory, scene: Scene, names: tuple[str, ...], exposures: Exposures | None = None
) -> tuple[float, ...]:
    """Mean PSNR on valid pixels, mean coverage, mean PSNR with black holes."""
    known, covered, whole = [], [], []
    for name in names:
        frame = scene[name].load()
        guidance = memory.project(scene[name].camera)
        use = np.ones(frame.rgb.shape[:2], bool) if frame.mask is None else frame.mask
        valid, rgb = guidance.valid[0], guidance.rgb[0]
        if exposures is not None:
            colors = np.round(255 * rgb).astype(np.uint8)
            rgb = exposures.as_taken_at(colors, scene[name].camera)
        value = psnr(rgb, frame.rgb, mask=valid & use)
        if value is not None:
            known.append(value)
        covered.append(float(valid[use].mean()))
        whole.append(psnr(rgb, frame.rgb, mask=use) or 0.0)
    return statistics.mean(known) if known else 0.0, *map(statistics.mean, (covered, whole))


def computed_depth(
    scene: Scene, context: tuple[str, ...], options: StereoOptions
) -> tuple[dict[str, DepthMap], float, float]:
    """The depth of the context, the voxel that suits it, and the seconds a view."""
    chosen = choose_source(scene, context, "plane-sweep", stereo=options)
    voxel = automatic_voxel(scene, context, chosen.source, percentile=50)
    start = time.perf_counter()
    depths = {name: chosen.source.depth(scene, scene[name], scene[name].load()) for name in context}
    return depths, voxel, (time.perf_counter() - start) / len(context)


def from_depth(
    scene: Scene, depths: dict[str, DepthMap], voxel: float, exposures: Exposures | None = None
) -> SpatialMemory:
    """The memory of computed depth, its colours at one exposure if that is given."""
    memory = SpatialMemory(voxel, origin=np.rint(scene.cameras.centers.mean(axis=0)))
    for name, found in depths.items():
        frame = scene[name].load()
        memory.observe(
            frame.rgb if exposures is None else exposures.common(frame.rgb, name),
            found.depth,
            scene[name].camera,
            round=0,
            confidence=found.confidence,
            mask=frame.mask,
        )
    return memory


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
            frame=memory.frame,
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
    parser.add_argument("--variants", action="store_true", help="also without the defaults' parts")
    args = parser.parse_args()
    print("project  method  PSNR dB  coverage %  whole dB  s/view")
    for path in args.projects:
        scene = open_project(path)
        held_out = select(scene.names, "every:8")
        context = select(scene.names, "not:every:8")

        def tell(
            label: str, figures: tuple[float, ...], seconds: str = "-", name=path.name
        ) -> None:
            known, covered, whole = figures
            print(f"{name}  {label}  {known:.2f}  {100 * covered:.1f}  {whole:.2f}  {seconds}",
                  flush=True)  # fmt: skip

        for width in FOOTPRINTS:
            figures = quality(from_sparse(scene, context, width), scene, held_out)
            tell(f"sparse, {width} px", figures)
        variants = {**(VARIANTS if args.variants else {}), "computed depth": StereoOptions()}
        for label, options in variants.items():
            depths, voxel, seconds = computed_depth(scene, context, options)
            memory = from_depth(scene, depths, voxel)
            tell(label, quality(memory, scene, held_out), f"{seconds:.2f}")
        exposures = estimate_exposures(scene, depths)
        memory = from_depth(scene, depths, voxel, exposures)
        tell("the same, one exposure", quality(memory, scene, held_out, exposures))


if __name__ == "__main__":
    main()
