"""Colours of observations by round, source, confidence, views or depth error, and of cameras.

Eyes that are blind for red or green tell them apart.

Scales run along viridis; unknown is grey. What is coloured by its source keeps some of the
picture's light and shade, without which nothing could be recognised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from viz.plots.canvas import COLORS, GREY, rgb_of

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory

TrueDepth = Callable[[str], "NDArray[np.float32] | None"]

CONTEXT, TARGET = "context", "target"
# Of cameras by their kind.
KINDS = {CONTEXT: COLORS["observed"], TARGET: COLORS["generated"]}
# By name, with what a menu calls it.
MODES = {
    "color": "colour",
    "round": "round",
    "source": "observed / scanned / generated",
    "confidence": "confidence",
    "views": "view count",
    "depth-error": "depth error",
}
# Equally spaced on the scale.
VIRIDIS = ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30",
           "#fde725")  # fmt: skip
# A relative depth error that is as bad as any worse one.
WORST_ERROR = 0.1


@dataclass(frozen=True)
class Legend:
    """How to read the colours."""

    text: str  # what is shown, with its unit
    swatches: tuple[tuple[str, str], ...] = ()  # colours (#rrggbb) with their meaning
    scale: tuple[str, str] | None = None  # what the two ends of viridis stand for


@dataclass(frozen=True, eq=False)
class PointColors:
    """Colours (P, 3) uint8 of the points that were asked for, and their legend."""

    rgb: NDArray[np.uint8]
    legend: Legend


def point_colors(
    memory: SpatialMemory,
    mode: str,
    *,
    rows: NDArray[np.int64] | None = None,
    true_depth: TrueDepth | None = None,
    counts: NDArray[np.int64] | None = None,
) -> PointColors:
    """Colours of observations; an observation's is the same whichever others are asked for.

    Args:
        mode: of MODES.
        rows: (P,) the observations; None for all.
        true_depth: the recorded depth (H, W) of a view by its name, or None; for "depth-error".
        counts: the memory's view_counts, for "views"; None: they are counted.
    """
    chosen = np.arange(len(memory)) if rows is None else rows
    if mode == "color":
        return PointColors(memory.columns.colors[chosen], Legend("as photographed or completed"))
    if mode == "round":
        return _by_round(memory, chosen)
    if mode == "source":
        return _by_source(memory, chosen)
    if mode == "confidence":
        return _by_confidence(memory, chosen)
    if mode == "views":
        counts = view_counts(memory) if counts is None else counts
        top = max(2, int(counts.max(initial=1)))
        legend = Legend("views with observations in the point's voxel", scale=("1", str(top)))
        return PointColors(viridis((counts[chosen] - 1) / (top - 1)), legend)
    return _by_depth_error(memory, chosen, true_depth)


def view_counts(memory: SpatialMemory) -> NDArray[np.int64]:
    """(N,) int64, for each observation how many views have observations in its voxel.

    What several views agreed on counts for the one that keeps it, so this is the least number.
    """
    from gvtools.memory.thinning import thin

    if not len(memory):
        return np.zeros(0, np.int64)
    voxel = thin(memory, None).group
    views = len(memory.views)
    pairs = np.unique(voxel * views + memory.columns.view)
    return np.bincount(pairs // views, minlength=int(voxel.max(initial=-1)) + 1)[voxel]


def depth_errors(
    memory: SpatialMemory, rows: NDArray[np.int64], true_depth: TrueDepth
) -> NDArray[np.float32]:
    """(P,) float32 |z - z true| / z true of observations in the view they came from.

    NaN where that view has no recorded depth at the pixel. Of a sensor's own views this is what
    averaging in voxels changed; of completed views and computed depth it is the error.
    """
    errors = np.full(len(rows), np.nan, np.float32)
    columns, views = memory.columns, memory.views
    view_of = columns.view[rows]
    for view in np.unique(view_of).tolist():
        camera = views[view].camera
        truth = true_depth(camera.names[0])
        shape = (int(camera.height[0]), int(camera.width[0]))
        if truth is None or truth.shape != shape:
            continue
        mine = np.flatnonzero(view_of == view)
        at = rows[mine]
        local = columns.positions[at].astype(np.float64)
        pose = views.cam_from_local[view]
        seen = local @ pose[:3, :3].T + pose[:3, 3]
        z = seen[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.floor((seen @ camera.K[0].T)[:, :2] / z[:, None])
        usable = (z > 0) & (xy >= 0).all(axis=1) & (xy < shape[::-1]).all(axis=1)
        mine, z, xy = mine[usable], z[usable], xy[usable].astype(np.int64)
        expected = truth[xy[:, 1], xy[:, 0]].astype(np.float64)
        known = expected > 0
        errors[mine[known]] = np.abs(z[known] - expected[known]) / expected[known]
    return errors


def viridis(share: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(P, 3) uint8 colours of values in [0, 1]; what lies outside takes the ends' colours."""
    anchors = np.array([rgb_of(color) for color in VIRIDIS], np.float64)
    at = np.linspace(0, 1, len(anchors))
    share = np.clip(share, 0, 1)
    return np.stack([np.interp(share, at, anchors[:, k]) for k in range(3)], 1).round().astype("u1")


def _by_round(memory: SpatialMemory, rows: NDArray[np.int64]) -> PointColors:
    rounds = memory.views.round[memory.columns.view[rows]]
    last = max(1, *memory.rounds, 1)
    rgb = viridis((rounds - 1) / max(1, last - 1))
    rgb[rounds == 0] = rgb_of(GREY)
    scale = ("round 1", f"round {last}") if last > 1 else None
    swatches = ((GREY, "context (round 0)"), *(() if scale else ((VIRIDIS[0], "round 1"),)))
    return PointColors(rgb, Legend("round that a point was fused in", swatches, scale))


def _by_source(memory: SpatialMemory, rows: NDArray[np.int64]) -> PointColors:
    names = ("observed", "generated", "scanned")
    tint = np.array([rgb_of(COLORS[name]) for name in names], np.float32)
    light = memory.columns.colors[rows] @ np.array([0.299, 0.587, 0.114], np.float32) / 255
    view = memory.columns.view[rows]
    kind = memory.views.generated[view] + 2 * memory.views.scanned[view].astype(np.int64)
    rgb = np.clip(tint[kind] * (0.45 + 0.75 * light)[:, None], 0, 255)
    shown = names if memory.views.scanned.any() else names[:2]
    swatches = tuple((COLORS[name], name) for name in shown)
    return PointColors(rgb.round().astype(np.uint8), Legend("where a point comes from", swatches))


def _by_confidence(memory: SpatialMemory, rows: NDArray[np.int64]) -> PointColors:
    confidence = memory.confidence
    spread = confidence[:: max(1, len(confidence) // 100_000)]
    low, high = np.percentile(spread, (1, 99)) if len(spread) else (0.1, 1.0)
    high = max(float(high), 1.01 * float(low))
    share = np.log(confidence[rows] / low) / np.log(high / low)
    legend = Legend("confidence, logarithmic, no unit", scale=(f"{low:.2g}", f"{high:.2g}"))
    return PointColors(viridis(share), legend)


def _by_depth_error(
    memory: SpatialMemory, rows: NDArray[np.int64], true_depth: TrueDepth | None
) -> PointColors:
    errors = depth_errors(memory, rows, true_depth or (lambda name: None))
    known = np.isfinite(errors)
    rgb = np.empty((len(rows), 3), np.uint8)
    rgb[:] = rgb_of(GREY)
    if not known.any():
        return PointColors(rgb, Legend("no view has a recorded depth", ((GREY, "unknown"),)))
    rgb[known] = viridis(errors[known] / WORST_ERROR)
    legend = Legend(
        "depth error in the point's own view, share of the recorded depth",
        ((GREY, "unknown"),),
        ("0 %", f"{WORST_ERROR:.0%} and more".replace("%", " %")),
    )
    return PointColors(rgb, legend)
