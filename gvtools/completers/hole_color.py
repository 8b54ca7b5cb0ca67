"""Colour of holes: diffusion from the rim that does not cross depth edges.

A hole pixel with a filled depth takes colour from rim pixels whose surface reaches it; then the
membrane equation is relaxed inside the hole, with links that are cut where inverse depth jumps.
So a hole beside a nearer object is coloured by the background alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.completers.hole_depth import DIRECTIONS, HoleDepth
from gvtools.kernels import compiled

# A rim pixel colours a hole pixel when its plane meets the filled inverse depth to this share.
SAME_DEPTH = 0.05
# Neighbours whose inverse depths differ by more than this share are nearly unlinked.
EDGE = 0.02
# Over-relaxation; 1.8 suits holes some tens of pixels wide.
RELAXATION = 1.8


def fill_color(
    rgb: NDArray[np.float32],
    known: NDArray[np.bool_],
    surface: HoleDepth,
    *,
    evidence: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
    sweeps: int = 60,
) -> NDArray[np.float32]:
    """Diffuse colour from the rim into the holes, along surfaces.

    Args:
        rgb: (H, W, 3) in [0, 1].
        known: (H, W) bool, where ``rgb`` is known; it is returned unchanged there.
        surface: the filled depth of the same view.
        evidence: colours (H, W, 3) that other photographs suggest for hole pixels, and their
            weight (H, W), 0 = none; a weight of 1 counts as much as one neighbour.
        sweeps: relaxation sweeps.

    Returns:
        (H, W, 3) float32; 0 where no depth was filled.
    """
    filled = np.where(known[..., None], rgb, np.float32(0))
    holes = np.flatnonzero(~known & (surface.inverse > 0))
    if not len(holes):
        return filled
    result = filled.astype(np.float64)
    _seed_colors(
        result,
        holes,
        surface.inverse,
        surface.hits,
        surface.planes,
        surface.plane_of.ravel(),
        DIRECTIONS,
    )
    hint, weight = np.zeros((1, 1, 3), np.float32), np.zeros((1, 1), np.float32)
    if evidence is not None:
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
    hinted = len(weight) > 1
    # What each pixel is drawn to is a mean: of four neighbours, whose shares are found once, and
    # of what the data say.
    share = np.zeros((count, 4))
    given = np.zeros((count, 3))
    step = np.zeros(count)
    for m in range(count):
        i = holes[m]
        data = weight[i] if hinted else 0.0
        total = links[m, 0] + links[m, 1] + links[m, 2] + links[m, 3] + data
        # A pixel cut off from all neighbours keeps its seed.
        if total > 1e-3:
            step[m] = RELAXATION
            for k in range(4):
                share[m, k] = links[m, k] / total
            for c in range(3):
                given[m, c] = data * hint[i, c] / total if hinted else 0.0
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
