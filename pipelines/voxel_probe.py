"""How coarse a memory may be: context views, predicted from their neighbours at several edges.

A footprint says what a pixel could show, not what the pictures do: blur, noise and the mixing of
views often leave less, and coarser voxels then store a fraction of it and look the same. Where
pictures and depth are sharp, several views together show more than one pixel could.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.grid_frame import grid_frame
from pipelines.sampling import sampled

if TYPE_CHECKING:
    from gvtools.scenes.scene import Frame, Scene
    from pipelines.config import RunConfig

# Edges that are tried, in shares of the one given.
SCALES = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0)
# The first of them.
START = 2.0
# Views that are predicted, and neighbours that each is predicted from.
PROBES, NEIGHBOURS = 3, 4
# Fewer valid pixels of a view tell nothing.
LEAST = 1000
# Mean squared errors below it, of one part in a hundred, are one: nobody sees them.
UNSEEN = 1e-4


def sufficient_scale(
    scene: Scene,
    names: Sequence[str],
    voxel: float,
    *,
    config: RunConfig,
    loss: float,
    say: Callable[[str], None] | None = None,
) -> float:
    """The coarsest of ``SCALES`` that predicts views within ``loss`` of the best one.

    Args:
        scene: the project.
        names: context views with recorded depth.
        voxel: edge, scene units.
        config: of the run: how points are lifted, kept and projected.
        loss: dB that the mean PSNR of the predicted views may fall behind.
        say: is told what was found.

    Returns:
        A share of ``voxel``; 1 where there are too few views to tell.
    """
    if len(names) <= NEIGHBOURS:
        return 1.0
    frames: dict[str, Frame] = {}
    probes = [(name, _nearest(scene, names, name)) for name in sampled(names, PROBES)]
    shown: dict[float, list[tuple[NDArray[np.float32], NDArray[np.bool_]]]] = {}

    def look(scale: float) -> dict[float, float]:
        """PSNR of each scale looked at so far; none where there is too little to compare."""
        shown[scale] = [
            _predicted(scene, name, others, scale * voxel, config, frames)
            for name, others in probes
        ]
        # What the finest of these memories knows; coarser ones know more.
        masks = [mask for _, mask in shown[min(shown)]]
        return {at: _psnr(pairs, masks) for at, pairs in shown.items()} if _enough(masks) else {}

    # Of finer edges the PSNR rises, then falls: no more are looked at than it takes to see that.
    found = look(START)
    for scale in [scale for scale in reversed(SCALES) if scale < START]:
        found = look(scale)
        if not found:
            return 1.0
        if found[scale] < max(found.values()):
            break
    for scale in [scale for scale in SCALES if scale > START]:
        if not found or found[max(found)] < max(found.values()) - loss:
            break
        found = look(scale)
    if not found:
        return 1.0
    best = max(found.values())
    chosen = max(scale for scale, psnr in found.items() if psnr >= best - loss)
    if say is not None:
        said = ", ".join(
            f"{scale * voxel:.3g}: {psnr:.2f} dB" for scale, psnr in sorted(found.items())
        )
        say(f"voxel edge by {len(probes)} context views predicted from their neighbours ({said})")
    return chosen


def _enough(masks: Sequence[NDArray[np.bool_]]) -> bool:
    return any(mask.sum() >= LEAST for mask in masks)


def _psnr(
    pairs: Sequence[tuple[NDArray[np.float32], NDArray[np.bool_]]],
    masks: Sequence[NDArray[np.bool_]],
) -> float:
    """Mean over the views whose mask holds enough pixels."""
    errors = [
        float(error[mask].mean())
        for (error, _), mask in zip(pairs, masks, strict=True)
        if mask.sum() >= LEAST
    ]
    return float(np.mean([-10 * np.log10(max(error, UNSEEN)) for error in errors]))


def _nearest(scene: Scene, names: Sequence[str], name: str) -> list[str]:
    """The views that stand and look most like one."""
    camera = scene[name].camera
    others = [other for other in names if other != name]
    cameras = scene.subset(others).cameras
    apart = np.linalg.norm(cameras.centers - camera.centers, axis=1)
    forward = cameras.world_from_cam[:, :3, 2] @ camera.world_from_cam[0, :3, 2]
    spread = max(float(np.median(apart)), 1e-12)
    order = np.argsort(apart / spread + (1 - forward), kind="stable")
    return [others[i] for i in order[:NEIGHBOURS]]


def _predicted(
    scene: Scene,
    name: str,
    others: Sequence[str],
    voxel: float,
    config: RunConfig,
    frames: dict[str, Frame],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(H, W) squared colour error of a view, and where its neighbours' memory knows it."""
    for other in (name, *others):
        if other not in frames:
            frames[other] = scene[other].load()
    view, truth = scene[name], frames[name]
    frame = grid_frame(scene, others)
    memory = SpatialMemory(voxel, origin=frame.origin, axes=frame.axes, options=config.memory)
    for other in others:
        seen = frames[other]
        assert seen.depth is not None
        points = back_project(
            seen.rgb,
            seen.depth,
            scene[other].camera,
            frame=frame,
            mask=seen.mask,
            options=config.back_projection,
            joined=config.savings.joined * voxel,
        )
        memory.fuse(points, round=0)
    guidance = memory.project(view.camera, options=config.splat)
    known = guidance.valid[0] if truth.mask is None else guidance.valid[0] & truth.mask
    error = guidance.rgb[0] - truth.rgb.astype(np.float32) / np.float32(255)
    return np.square(error).mean(-1), known
