"""Voxels of a run: frame and edge of the grid, and how coarse it may be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import DegenerateError, ProjectError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.settings import with_values
from gvtools.view_selection import evenly_spread, nearest_views

if TYPE_CHECKING:
    from gvtools.depth.source import DepthSource
    from gvtools.scenes.scene import Frame, Scene, View
    from pipelines.reconstruction.settings import RunSettings


def grid_frame(scene: Scene, names: Sequence[str]) -> LocalFrame:
    """The frame of the first of the context cameras, by name, not by the project's order.

    A world that is scaled, turned, shifted or listed otherwise gives the same memory in it.
    """
    return LocalFrame.of_camera(scene[min(names)].camera)


def automatic_voxel(
    scene: Scene,
    context: Sequence[str],
    source: DepthSource,
    *,
    percentile: float,
    say: Callable[[str], None] | None = None,
) -> float:
    """The median over some views of a percentile of their pixel footprints z / f, scene units.

    Recorded depth and sparse points tell z. Only where no view has either is depth computed, by a
    rough version of the source.
    """
    from gvtools.depth.source import is_recorded

    rows = {name: row for row, name in enumerate(scene.names)}
    tracked = set() if scene.points is None else set(scene.points.view_index.tolist())
    with_depth = [
        name for name in context if is_recorded(source, scene[name]) or rows[name] in tracked
    ]
    footprints: list[float] = []
    for name in evenly_spread(with_depth):
        view = scene[name]
        depth = view.load().depth if is_recorded(source, view) else _of_points(scene, rows[name])
        if depth is not None:
            footprints += _footprint(view, depth[depth > 0], percentile)
    if not footprints:
        footprints = _computed(scene, context, source, percentile=percentile, say=say)
    return float(np.median(footprints))


def _computed(
    scene: Scene,
    context: Sequence[str],
    source: DepthSource,
    *,
    percentile: float,
    say: Callable[[str], None] | None,
) -> list[float]:
    """Footprints by a rough source."""
    from gvtools.depth.choice import rough_source
    from gvtools.depth.source import is_recorded

    rough = rough_source(scene, source)
    views = [n for n in context if rough.covers(scene[n]) and not is_recorded(source, scene[n])]
    if not views:
        raise ProjectError(f"{scene.root}: the context's depth maps are empty; see 'gvtools check'")
    names = evenly_spread(views)
    if say is not None:
        kind, then = "depth", "and kept for the run"
        if rough is not source:
            kind, then = "rough depth", "which --voxel EDGE saves"
        say(
            f"no sparse points or recorded depth to go by: the voxel edge comes from {kind} "
            f"({rough.name}) of {len(names)} of {len(context)} context views, computed now, {then}"
        )
    footprints: list[float] = []
    reason = "it is empty"
    for name in names:
        view = scene[name]
        try:
            depth = rough.depth(scene, view, view.load()).depth
        except DegenerateError as error:
            reason = str(error)
            continue
        footprints += _footprint(view, depth[depth > 0], percentile)
    if not footprints:
        raise ProjectError(
            f"{scene.root}: no depth was found to derive a voxel edge from ({reason}); give "
            "--voxel EDGE, in scene units"
        )
    return footprints


def _of_points(scene: Scene, row: int) -> NDArray[np.float32]:
    """Depths of the sparse points in a view's tracks."""
    points = scene.points
    assert points is not None
    mine = points.point_index[points.view_index == row]
    _, z = scene.views[row].camera.project(points.positions[mine])
    return z[0].astype(np.float32)


def _footprint(view: View, depths: NDArray[np.float32], percentile: float) -> list[float]:
    """One footprint, or none without depth."""
    if not depths.size:
        return []
    focal = float(np.sqrt(view.camera.K[0, 0, 0] * view.camera.K[0, 1, 1]))
    return [float(np.percentile(depths, percentile)) / focal]


# Edges that are tried, in shares of the one given.
SCALES = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0)
# The first of them.
START = 2.0
# Views that are predicted, and neighbours that each is predicted from.
PROBES, NEIGHBOURS = 3, 4
# A quarter of their pixels is looked at, in squares of this side, and what falls a little beside.
TILE, MARGIN, BLOCK = 48, 6, 2
# Memories that are fused at once.
THREADS = 2
# Fewer valid pixels of a view tell nothing.
LEAST = 250
# Mean squared errors below it, of one part in a hundred, are one: nobody sees them.
UNSEEN = 1e-4


def sufficient_scale(
    scene: Scene,
    names: Sequence[str],
    *,
    config: RunSettings,
    loss: float,
    say: Callable[[str], None] | None = None,
) -> float:
    """The coarsest share of the configured voxel edge that shows as much as the best one.

    Of ``SCALES``, it predicts views within ``loss`` dB of the best; 1 where too few views tell.
    """
    voxel = config.voxel
    if voxel is None or len(names) <= NEIGHBOURS:
        return 1.0
    frames: dict[str, Frame] = {}
    probes = [
        _probe(scene, name, _nearest(scene, names, name), frames=frames)
        for name in evenly_spread(names, PROBES)
    ]
    shown: dict[float, list[tuple[NDArray[np.float32], NDArray[np.bool_]]]] = {}

    def look(scale: float) -> dict[float, float]:
        """PSNR of each scale looked at so far; none where there is too little to compare."""
        scaled = at_scale(config, scale)
        with ThreadPoolExecutor(THREADS) as pool:
            memories = pool.map(lambda probe: _fused(probe, scaled), probes)
            shown[scale] = [
                _predicted(probe, memory, scaled)
                for probe, memory in zip(probes, memories, strict=True)
            ]
        # Pixels that the finest of these memories covers; coarser ones cover more.
        masks = [mask for _, mask in shown[min(shown)]]
        if not any(mask.sum() >= LEAST for mask in masks):
            return {}
        return {at: _psnr(pairs, masks) for at, pairs in shown.items()}

    psnrs = _search(look, loss)
    if not psnrs:
        return 1.0
    best = max(psnrs.values())
    chosen = max(scale for scale, psnr in psnrs.items() if psnr >= best - loss)
    if say is not None:
        text = ", ".join(
            f"{scale * voxel:.3g}: {psnr:.2f} dB" for scale, psnr in sorted(psnrs.items())
        )
        say(f"voxel edge by {len(probes)} context views predicted from their neighbours ({text})")
    return chosen


def _search(look: Callable[[float], dict[float, float]], loss: float) -> dict[float, float]:
    """PSNR by scale, of as few scales as tell which is best; empty where too little compares.

    Of finer edges the PSNR rises, then falls: no more are looked at than it takes to see that.
    ``look`` adds a scale, and gives the PSNR of all so far.
    """
    psnrs = look(START)
    for scale in [scale for scale in reversed(SCALES) if scale < START]:
        psnrs = look(scale)
        if not psnrs:
            return {}
        # A gain of less than what may be lost decides nothing.
        if psnrs[scale] < max(psnr for at, psnr in psnrs.items() if at > scale) + loss:
            break
    for scale in [scale for scale in SCALES if scale > START]:
        if not psnrs or psnrs[max(psnrs)] < max(psnrs.values()) - loss:
            break
        psnrs = look(scale)
    return psnrs


def at_scale(config: RunSettings, scale: float) -> RunSettings:
    """``config`` with all voxels so many times as wide."""
    assert config.voxel is not None
    changes = {
        "voxel": scale * config.voxel,
        "memory.voxels_per_footprint": scale * config.memory.voxels_per_footprint,
    }
    return with_values(config, changes)


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
    spread = float(np.median(np.linalg.norm(cameras.centers - camera.centers, axis=1)))
    rows = nearest_views(cameras, camera, NEIGHBOURS, unit=max(spread, 1e-12))
    return [others[row] for row in rows]


@dataclass(frozen=True, eq=False)
class _Probe:
    """Tiles of a view, and what its neighbours see of the place."""

    camera: Cameras  # of the view
    rgb: NDArray[np.uint8]  # (H, W, 3) uint8, its photograph
    tiles: NDArray[np.bool_]  # (H, W) bool, which of its pixels count
    frame: LocalFrame  # for the memory of the neighbours
    # Each neighbour's camera and picture, and which of its pixels fall into the tiles or beside
    # them.
    seen: list[tuple[Cameras, Frame, NDArray[np.bool_]]]


def _probe(scene: Scene, name: str, others: Sequence[str], *, frames: dict[str, Frame]) -> _Probe:
    """``frames`` keeps the pictures."""
    for other in (name, *others):
        if other not in frames:
            frames[other] = scene[other].load()
    camera, truth = scene[name].camera, frames[name]
    row, col = (np.arange(length) // TILE % 2 == 0 for length in truth.rgb.shape[:2])
    tiles = row[:, None] & col[None]
    wanted = cv2.dilate(tiles.astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2, np.uint8)) > 0
    cameras = {other: scene[other].camera for other in others}
    seen = [
        (own, frames[other], _pixels_onto(own, frames[other], camera, wanted=wanted))
        for other, own in cameras.items()
    ]
    if truth.mask is not None:
        tiles &= truth.mask
    return _Probe(camera, truth.rgb, tiles, grid_frame(scene, others), seen)


def _pixels_onto(
    camera: Cameras, frame: Frame, onto: Cameras, *, wanted: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(H, W), the pixels with depth that fall on the ``wanted`` pixels of another camera."""
    assert frame.depth is not None
    depth = frame.depth[::BLOCK, ::BLOCK]
    use = np.isfinite(depth) & (depth > 0)
    rays, pose = camera.rays()[::BLOCK, ::BLOCK][use], camera.world_from_cam[0]
    xy, z = onto.project((rays * depth[use, None]) @ pose[:3, :3].T + pose[:3, 3])
    height, width = wanted.shape
    inside = (z[0] > 0) & (xy[0] >= 0).all(axis=1) & (xy[0] < (width, height)).all(axis=1)
    col, row = xy[0][inside].astype(np.int64).T
    inside[inside] = wanted[row, col]
    use[use] = inside
    whole = np.repeat(np.repeat(use, BLOCK, axis=0), BLOCK, axis=1)
    whole = whole[: frame.depth.shape[0], : frame.depth.shape[1]]
    return whole if frame.mask is None else whole & frame.mask


def _fused(probe: _Probe, config: RunSettings) -> SpatialMemory:
    """The neighbours' memory."""
    assert config.voxel is not None
    memory = SpatialMemory(
        config.voxel, origin=probe.frame.origin, axes=probe.frame.axes, options=config.memory
    )
    for camera, frame, mask in probe.seen:
        assert frame.depth is not None
        memory.observe(
            frame.rgb,
            frame.depth,
            camera,
            round=0,
            mask=mask,
            options=config.back_projection,
            pixel_binning=config.savings.pixel_binning,
        )
    return memory


def _predicted(
    probe: _Probe, memory: SpatialMemory, config: RunSettings
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(H, W) squared colour error of a view, and where in its tiles the memory knows it."""
    guidance = memory.project(probe.camera, options=config.splat)
    error = guidance.rgb[0] - probe.rgb.astype(np.float32) / np.float32(255)
    return np.square(error).mean(-1), guidance.valid[0] & probe.tiles
