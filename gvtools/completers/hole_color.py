"""Colour of holes: diffusion from the rim that does not cross depth edges.

A hole pixel with a filled depth takes colour from rim pixels whose surface reaches it; then the
membrane equation is relaxed inside the hole, with links that are cut where inverse depth jumps.
So a hole beside a nearer object is coloured by the background alone.

Sensors and stereo leave pixels without depth that the photograph shows all the same. Once a hole
pixel has a filled depth, its point is looked up in the context photographs. A photograph counts for
little where an error of the filled depth would move the point far in it, and not at all where its
own depth shows another surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64, concatenate
from gvtools.completers.base import ContextView
from gvtools.completers.hole_depth import DIRECTIONS, HoleDepth
from gvtools.kernels import compiled
from gvtools.view_selection import in_view

# A rim pixel colours a hole pixel when its plane meets the filled inverse depth to this share, and
# a photograph does where its own depth meets the point's.
SAME_DEPTH = 0.05
# Neighbours whose inverse depths differ by more than this share are nearly unlinked.
EDGE = 0.02
# Over-relaxation; 1.8 suits holes some tens of pixels wide.
RELAXATION = 1.8
# A filled depth is taken to err by this share, plus this share per pixel from the rim.
DEPTH_ERROR, DEPTH_ERROR_PER_PIXEL = 0.01, 0.001
# A shift of so many pixels, from such an error, halves the weight of a photograph.
SHIFT_PIXELS = 2.0
# Colours this far apart are not of the same point.
SAME_COLOR = 0.1
# Hole points that stand for all of them when photographs are chosen.
SAMPLES = 400


def fill_color(
    rgb: NDArray[np.float32],
    known: NDArray[np.bool_],
    surface: HoleDepth,
    *,
    evidence: tuple[NDArray[np.float32], NDArray[np.float32]],
    sweeps: int,
) -> NDArray[np.float32]:
    """(H, W, 3) colour diffused from the rim into the holes, along surfaces; 0 where no depth is.

    ``evidence``: colours (H, W, 3) that other photographs suggest for hole pixels, and their weight
    (H, W), 0 = none; a weight of 1 counts as much as one neighbour.
    """
    filled = np.where(known[..., None], rgb, np.float32(0))
    holes = np.flatnonzero(~known & (surface.inverse > 0))
    if not len(holes):
        return filled
    result = filled.astype(np.float64)
    flat = surface.plane_of.ravel()
    _seed_colors(result, holes, surface.inverse, surface.hits, surface.planes, flat, DIRECTIONS)
    hint, weight = evidence
    share = (weight.ravel()[holes] / (1 + weight.ravel()[holes]))[:, None]
    seeds = result.reshape(-1, 3)
    seeds[holes] = seeds[holes] * (1 - share) + hint.reshape(-1, 3)[holes] * share
    neighbors, links = _links(holes, surface.inverse)
    relax(result.reshape(-1, 3), holes, neighbors, links, hint.reshape(-1, 3), weight.ravel(),
           sweeps)  # fmt: skip
    filled.reshape(-1, 3)[holes] = np.clip(result.reshape(-1, 3)[holes], 0, 1)
    return filled


@compiled()
def _seed_colors(rgb, holes, inverse, hits, planes, flat, directions):
    """Inverse-distance mean of the rim colours on the hole pixel's own surface."""
    width = inverse.shape[1]
    for i in holes:
        y, x = i // width, i % width
        value = inverse[y, x]
        total = red = green = blue = 0.0
        # Should no rim plane reach the filled depth, the closest one gives the colour.
        closest, closest_gap = -1, np.inf
        for k in range(len(directions)):
            h = hits[k, y, x]
            if h < 0:
                continue
            plane = planes[flat[h]]
            hy, hx = h // width, h % width
            gap = abs(plane[0] + plane[1] * (x - hx) + plane[2] * (y - hy) - value) / value
            if gap < closest_gap:
                closest, closest_gap = h, gap
            if gap < SAME_DEPTH:
                weight = planes[flat[h], 3] / ((x - hx) ** 2 + (y - hy) ** 2)
                total += weight
                red += weight * rgb[hy, hx, 0]
                green += weight * rgb[hy, hx, 1]
                blue += weight * rgb[hy, hx, 2]
        if total > 0:
            rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2] = red / total, green / total, blue / total
        elif closest >= 0:
            for c in range(3):
                rgb[y, x, c] = rgb[closest // width, closest % width, c]


@compiled()
def _links(holes, inverse):
    """(M, 4) row-major neighbours of hole pixels, and the strength of each link, 0 outside."""
    height, width = inverse.shape
    neighbors = np.zeros((len(holes), 4), np.int64)
    links = np.zeros((len(holes), 4))
    for m in range(len(holes)):
        y, x = holes[m] // width, holes[m] % width
        here = inverse[y, x]
        for k in range(4):
            y1 = y + (k == 0) - (k == 1)
            x1 = x + (k == 2) - (k == 3)
            if y1 < 0 or y1 >= height or x1 < 0 or x1 >= width or inverse[y1, x1] == 0:
                continue
            there = inverse[y1, x1]
            jump = abs(here - there) / min(here, there)
            neighbors[m, k] = y1 * width + x1
            links[m, k] = 1.0 / (1.0 + (jump / EDGE) ** 2) ** 2
    return neighbors, links


@compiled()
def relax(rgb, holes, neighbors, links, hint, weight, sweeps):
    """Successive over-relaxation of the membrane with data terms, in row-major order."""
    count = len(holes)
    # What each pixel is drawn to is a mean: of four neighbours, whose shares are found once, and
    # of what the data say.
    share = np.zeros((count, 4))
    given = np.zeros((count, 3))
    step = np.zeros(count)
    for m in range(count):
        i = holes[m]
        data = weight[i]
        total = links[m, 0] + links[m, 1] + links[m, 2] + links[m, 3] + data
        # A pixel cut off from all neighbours keeps its seed.
        if total > 1e-3:
            step[m] = RELAXATION
            for k in range(4):
                share[m, k] = links[m, k] / total
            for c in range(3):
                given[m, c] = data * hint[i, c] / total
    for _ in range(sweeps):
        for m in range(count):
            i = holes[m]
            red, green, blue = given[m, 0], given[m, 1], given[m, 2]
            for k in range(4):
                link, j = share[m, k], neighbors[m, k]
                red += link * rgb[j, 0]
                green += link * rgb[j, 1]
                blue += link * rgb[j, 2]
            rgb[i, 0] += step[m] * (red - rgb[i, 0])
            rgb[i, 1] += step[m] * (green - rgb[i, 1])
            rgb[i, 2] += step[m] * (blue - rgb[i, 2])


def depth_error(distance: Float64, spread: Float64) -> Float64:
    """(H, W) relative error that a filled depth is taken to have; see ``HoleDepth``."""
    return np.asarray(DEPTH_ERROR + DEPTH_ERROR_PER_PIXEL * distance + spread)


def look_up(
    camera: Cameras,
    depth: NDArray[np.float32],
    error: Float64,
    *,
    holes: NDArray[np.bool_],
    context: Sequence[ContextView],
    views: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colours (H, W, 3) that photographs show at holes' points, and their weight in [0, 1].

    ``depth`` (H, W) is filled, scene units, ``error`` its relative ``depth_error``. At most
    ``views`` photographs are used: those that see the holes most reliably.
    """
    colors = np.zeros((*depth.shape, 3), np.float32)
    weights = np.zeros(depth.shape, np.float32)
    rows, columns = np.nonzero(holes & (depth > 0))
    if not (context and views and len(rows)):
        return colors, weights
    rays = _rays(camera, rows, columns)
    z = depth[rows, columns].astype(np.float64)
    points = {"center": camera.centers[0], "rays": rays, "z": z, "error": error[rows, columns]}
    best = _best_views(context, views, **points)
    if not best:
        return colors, weights
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


def _best_views(
    context: Sequence[ContextView], most: int, *, center: Float64, rays: Float64, z: Float64,
    error: Float64,
) -> list[int]:  # fmt: skip
    """The photographs that show some of the points at all, the most reliable first."""
    some = slice(None, None, max(1, len(z) // SAMPLES))
    rays, z, error = rays[some], z[some], error[some]
    cameras = concatenate([view.camera for view in context])
    # Those in whose pictures any of the points falls, hidden or not.
    inside = in_view(cameras, center + rays * z[:, None]).any(axis=-1)
    scores = np.zeros(len(context))
    for index in np.flatnonzero(inside).tolist():
        scores[index] = _visible(context[index], center, rays, z=z, error=error)[2].sum()
    return [int(i) for i in np.argsort(-scores, kind="stable") if scores[i] > 0][:most]


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
