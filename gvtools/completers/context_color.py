"""Colours for hole pixels from the context photographs.

Sensors and stereo leave pixels without depth that the photograph shows all the same. Once a hole
pixel has a filled depth, its point is looked up in the photographs. A photograph counts for little
where an error of the filled depth would move the point far in it, and not at all where its own
depth shows another surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64, concatenate
from gvtools.completers.base import ContextView
from gvtools.view_selection import in_view

# A filled depth is taken to err by this share, plus this share per pixel from the rim.
DEPTH_ERROR, DEPTH_ERROR_PER_PIXEL = 0.01, 0.001
# A shift of so many pixels, from such an error, halves the weight of a photograph.
SHIFT_PIXELS = 2.0
# A context depth within this share of the point's agrees with it.
SAME_DEPTH = 0.05
# Colours this far apart are not of the same point.
SAME_COLOR = 0.1
# Hole points that stand for all of them when photographs are chosen.
SAMPLES = 400


def depth_error(distance: Float64, spread: Float64) -> Float64:
    """(H, W) relative error that a filled depth is taken to have.

    Args:
        distance: (H, W) pixels to the nearest known pixel.
        spread: (H, W) relative disagreement of what the fill was made from.
    """
    return np.asarray(DEPTH_ERROR + DEPTH_ERROR_PER_PIXEL * distance + spread)


def rank_views(
    camera: Cameras,
    depth: NDArray[np.float32],
    error: Float64,
    *,
    holes: NDArray[np.bool_],
    context: Sequence[ContextView],
) -> list[int]:
    """The photographs that show hole points at all, the most reliable first.

    Args:
        camera: the target, a batch of one.
        depth: (H, W) filled z-depth, scene units.
        error: (H, W) its relative error.
        holes: (H, W) bool, the pixels in question.
        context: the photographs.
    """
    rows, columns = np.nonzero(holes & (depth > 0))
    some = slice(None, None, max(1, len(rows) // SAMPLES))
    rows, columns = rows[some], columns[some]
    rays = _rays(camera, rows, columns)
    z = depth[rows, columns].astype(np.float64)
    points = {"center": camera.centers[0], "rays": rays, "z": z, "error": error[rows, columns]}
    scores = np.zeros(len(context))
    if context:
        cameras = concatenate([view.camera for view in context])
        # Those in whose pictures any of the points falls, hidden or not.
        inside = in_view(cameras, camera.centers[0] + rays * z[:, None]).any(axis=-1)
        for index in np.flatnonzero(inside).tolist():
            scores[index] = _visible(context[index], **points)[2].sum()
    return [int(i) for i in np.argsort(-scores, kind="stable") if scores[i] > 0]


def look_up(
    camera: Cameras,
    depth: NDArray[np.float32],
    error: Float64,
    *,
    holes: NDArray[np.bool_],
    context: Sequence[ContextView],
    views: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What the photographs show where the hole pixels' points project.

    Args:
        camera: the target, a batch of one.
        depth: (H, W) filled z-depth, scene units.
        error: (H, W) its relative error, ``depth_error``.
        holes: (H, W) bool, the pixels to look up.
        context: the photographs.
        views: how many of them to use: those that see the holes most reliably.

    Returns:
        Colours (H, W, 3) float32 and their weight (H, W) float32 in [0, 1], 0 = none.
    """
    colors = np.zeros((*depth.shape, 3), np.float32)
    weights = np.zeros(depth.shape, np.float32)
    best = rank_views(camera, depth, error, holes=holes, context=context)[: max(views, 0)]
    if not best:
        return colors, weights
    rows, columns = np.nonzero(holes & (depth > 0))
    rays = _rays(camera, rows, columns)
    z = depth[rows, columns].astype(np.float64)
    points = {"center": camera.centers[0], "rays": rays, "z": z, "error": error[rows, columns]}
    found = np.zeros((len(best), len(rows), 3))
    trust = np.zeros((len(best), len(rows)))
    for row, index in enumerate(best):
        xy, inside, weight = _visible(context[index], **points)
        found[row, inside] = _bilinear(context[index].rgb, xy[inside])
        trust[row] = weight
    # Each photograph gathers the votes of those that show much the same; the strongest group
    # wins, and what the others see instead lessens its weight.
    votes = np.zeros_like(trust)
    for row in range(len(best)):
        votes[row] = _agreement(found, found[row], trust).sum(axis=0) * (trust[row] > 0)
    leading = np.take_along_axis(found, votes.argmax(axis=0)[None, :, None], axis=0)[0]
    agree = _agreement(found, leading, trust)
    total = agree.sum(axis=0)
    mean = (agree[..., None] * found).sum(axis=0) / np.maximum(total, 1e-12)[:, None]
    colors[rows, columns] = mean
    harmony = total / np.maximum(trust.sum(axis=0), 1e-12)
    weights[rows, columns] = agree.max(axis=0) * harmony
    return colors, weights


def _rays(camera: Cameras, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Float64:
    """(N, 3) world-frame offsets of pixels from the camera's centre at depth z = 1."""
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    world_from_pixel = camera.world_from_cam[0, :3, :3] @ np.linalg.inv(camera.K[0])
    return np.asarray((world_from_pixel @ pixels).T)


def _agreement(found: Float64, reference: Float64, trust: Float64) -> Float64:
    """(S, N) trust of each photograph where its colour (S, N, 3) is near the reference (N, 3)."""
    apart = np.abs(found - reference).max(axis=-1)
    return np.asarray(trust * np.exp(-((apart / SAME_COLOR) ** 2)))


def _visible(
    view: ContextView, center: Float64, rays: Float64, *, z: Float64, error: Float64
) -> tuple[Float64, NDArray[np.bool_], Float64]:
    """Where points fall in a photograph (N, 2), whether inside (N,), and their weight (N,)."""
    xy, local_z = (part[0] for part in view.camera.project(center + rays * z[:, None]))
    nearer, _ = (
        part[0] for part in view.camera.project(center + rays * (z * (1 - error))[:, None])
    )
    height, width = view.rgb.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (xy > 0.5).all(axis=-1) & (xy[:, 0] < width - 0.5) & (xy[:, 1] < height - 0.5)
        shift = np.linalg.norm(nearer - xy, axis=-1)
    inside &= np.isfinite(shift)
    weight = np.where(inside, 1 / (1 + (shift / SHIFT_PIXELS) ** 2), 0.0)
    weight = np.nan_to_num(weight)
    if view.depth is not None:
        pixel = np.floor(np.where(inside[:, None], xy, 0)).astype(np.int64)
        seen = view.depth[pixel[:, 1], pixel[:, 0]]
        known = np.isfinite(seen) & (seen > 0)
        other = known & (np.abs(local_z / np.where(known, seen, 1) - 1) > SAME_DEPTH)
        weight[other] = 0
    return xy, inside, weight


def _bilinear(image: NDArray[np.float32], xy: Float64) -> Float64:
    """(N, 3) colours at positions (N, 2) at least half a pixel inside the image."""
    x, y = xy[:, 0] - 0.5, xy[:, 1] - 0.5
    x0 = np.minimum(x.astype(np.int64), image.shape[1] - 2)
    y0 = np.minimum(y.astype(np.int64), image.shape[0] - 2)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top = image[y0, x0] * (1 - fx) + image[y0, x0 + 1] * fx
    bottom = image[y0 + 1, x0] * (1 - fx) + image[y0 + 1, x0 + 1] * fx
    return top * (1 - fy) + bottom * fy
