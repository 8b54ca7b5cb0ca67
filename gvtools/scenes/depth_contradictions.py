"""Recorded depth whose unit is not that of the poses: neighbours' depth tells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import GvError
from gvtools.scenes.scene import Finding, Scene

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
    pairs = [(at, at + gap) for at in first for gap in GAPS if at + gap < len(numbers)]
    maps: dict[int, NDArray[np.float32] | None] = {}
    total, agreed = 0, np.zeros(len(FACTORS))
    for pair in pairs:
        a, b = (numbers[place] for place in pair)
        for number in (a, b):
            if number not in maps:
                maps[number] = _depth(scene, number)
        one, other = maps[a], maps[b]
        if one is None or other is None:
            continue
        cameras = scene.views[a].camera, scene.views[b].camera
        if np.linalg.norm(cameras[0].centers - cameras[1].centers) > 0:
            count, agreeing = _agreeing(one, other, cameras)
            total, agreed = total + count, agreed + agreeing
    if not total:
        return []
    now, best = agreed[len(FACTORS) // 2] / total, agreed.max() / total
    factor = float(FACTORS[agreed.argmax()])
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


def _depth(scene: Scene, number: int) -> NDArray[np.float32] | None:
    try:
        return scene.views[number].load().depth
    except GvError:  # said elsewhere
        return None


def _agreeing(
    one: NDArray[np.float32], other: NDArray[np.float32], cameras: tuple[Cameras, Cameras]
) -> tuple[int, NDArray[np.float64]]:
    """How many pixels of the first view are compared, and how many agree at each factor."""
    rows, columns = np.nonzero(one > 0)
    chosen = np.linspace(0, len(rows) - 1, min(PIXELS, len(rows))).astype(int)
    rows, columns = rows[chosen], columns[chosen]
    agreeing = np.zeros(len(FACTORS))
    if not len(rows):
        return 0, agreeing
    pixels = np.column_stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    rays = (pixels @ np.linalg.inv(cameras[0].K[0]).T) * one[rows, columns][:, None]
    world = cameras[0].world_from_cam[0]
    for i, factor in enumerate(FACTORS):
        points = (rays * factor) @ world[:3, :3].T + world[:3, 3]
        xy, z = cameras[1].project(points)
        with np.errstate(invalid="ignore"):
            inside = (z[0] > 0) & (xy[0] >= 0).all(1) & (xy[0] < other.shape[::-1]).all(1)
            x, y = np.where(inside[:, None], xy[0], 0).astype(int).T
            near = np.abs(z[0] - factor * other[y, x]) < SAME * factor * other[y, x]
        agreeing[i] = (inside & near).sum()
    return len(rows), agreeing
