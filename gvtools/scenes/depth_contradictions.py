"""Recorded depth whose unit is not that of the poses: neighbours' depth tells."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import GvError
from gvtools.scenes.scene import Finding, Scene, View

# Factors that depth may lack, a tenth apart, and how far depths that agree may differ.
FACTORS, SAME = 10 ** (np.arange(-96, 97) / 24), 0.01
# Views that are compared with those so many places after them, and pixels of each.
PROBES, GAPS, PIXELS = 4, (1, 4, 16), 800
# Depth is wrong when another factor makes so many agree, and it has less than the share of that.
AGREE, SHARE, FAR = 0.2, 0.7, 1.3


def unit_findings(scene: Scene) -> list[Finding]:
    """A warning when depth of neighbours agrees with the poses in another unit alone."""
    numbers = [number for number, view in enumerate(scene.views) if view.has_depth]
    first = sorted({*np.linspace(0, len(numbers) - 1, PROBES).astype(int).tolist()})
    depth_of = cache(_depth)
    pairs = [(at, at + gap) for at in first for gap in GAPS if at + gap < len(numbers)]
    compared = []
    for pair in pairs:
        a, b = (scene.views[numbers[place]] for place in pair)
        one, other = depth_of(a), depth_of(b)
        moved = np.linalg.norm(a.camera.centers - b.camera.centers) > 0
        if one is not None and other is not None and moved:
            compared.append((one, other, (a.camera, b.camera)))
    count, (now,) = _agreeing(compared, np.ones(1))
    if not count or now > SHARE:  # no factor makes so much more agree
        return []
    _, agreeing = _agreeing(compared, FACTORS)
    best, factor = agreeing.max(), float(FACTORS[agreeing.argmax()])
    if best < AGREE or now > SHARE * best or max(factor, 1 / factor) < FAR:
        return []
    times = f"{float(f'{factor:.2g}'):g}"
    line = (
        f"recorded depth contradicts the poses: {now:.0%} of neighbouring views' depth agrees, "
        f"{best:.0%} if depth were {times} times as large; the unit of one of them is wrong: "
        "state that of depth (--depth-unit of RGB-D folders, depth_unit_scale_factor or "
        "integer_depth_scale of transforms.json) or give poses in the same unit"
    )
    return [Finding("warning", line)]


def _depth(view: View) -> NDArray[np.float32] | None:
    try:
        return view.load().depth
    except GvError:  # said elsewhere
        return None


def _agreeing(
    pairs: Sequence[tuple[NDArray[np.float32], NDArray[np.float32], tuple[Cameras, Cameras]]],
    factors: NDArray[np.float64],
) -> tuple[int, NDArray[np.float64]]:
    """How many pixels of first views are compared, and the share that agrees at each factor."""
    total, agreed = 0, np.zeros(len(factors))
    for one, other, cameras in pairs:
        rows, columns = np.nonzero(one > 0)
        chosen = np.linspace(0, len(rows) - 1, min(PIXELS, len(rows))).astype(int)
        rows, columns = rows[chosen], columns[chosen]
        pixels = np.column_stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
        rays = (pixels @ np.linalg.inv(cameras[0].K[0]).T) * one[rows, columns][:, None]
        to_other = cameras[1].cam_from_world[0] @ cameras[0].world_from_cam[0]
        points = factors[:, None, None] * (rays @ to_other[:3, :3].T) + to_other[:3, 3]
        z = points[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = (points @ cameras[1].K[0].T)[..., :2] / z[..., None]
            inside = (z > 0) & (xy >= 0).all(-1) & (xy < other.shape[::-1]).all(-1)
        x, y = np.moveaxis(np.where(inside[..., None], xy, 0).astype(int), -1, 0)
        expected = factors[:, None] * other[y, x]
        total += len(rows)
        agreed += (inside & (np.abs(z - expected) < SAME * expected)).sum(1)
    return total, agreed / max(total, 1)
