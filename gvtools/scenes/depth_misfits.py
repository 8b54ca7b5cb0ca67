"""Recorded depth that is not of its pictures: displaced, of another lens, too far or too near.

Neighbours' depth does not tell, where all maps are wrong alike. But where surfaces end, pictures
mostly have edges; and what a view shows is seen in others where depth and poses place it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.scenes.depth_contradictions import climbed, frame_there, sampled, unit_findings
from gvtools.scenes.pixel_contradictions import CONTRAST, GIVE, detail, shown
from gvtools.scenes.scene import Finding, Frame, Scene

Float64 = NDArray[np.float64]

# Views whose edges are compared, how many at least, the pictures' longer side then [pixels], edges
# of each; depth ends where it jumps by this share; edges count up to so many times those around.
VIEWS, FEWEST_VIEWS, SIDE, EDGES, FEWEST, JUMP, STRONGEST = 8, 4, 320, 400, 150, 0.08, 4.0
# Maps are tried moved right and down [longer sides] and larger [shares], from the best on by these
# steps. Those whose near surfaces are too wide or narrow, as stereo has them, are in place.
SHIFTS, SIZES, STEPS = np.arange(-8, 9) / 160, np.arange(-3, 4) / 20, (0.004, 0.002)
GROWN = [np.array([0, 0, 0, wider]) for wider in np.arange(-4, 5) / 320]
FLIPS = {"mirrored": (-1, 1), "upside down": (1, -1), "turned by half": (-1, -1)}
# They are displaced that are so far away, are so much better there and stand out so much among all
# places. On three recordings it is at most 1.04 times better, also with maps that are coarse, noisy
# or spread; with a camera 25 mm beside 1.23 and 1.87.
FAR, BETTER, CLEAR = 0.006, 1.12, 1.6
# Views of which places, where depth is smooth, are sought in those so many after them that stand
# within a share of the depth and look almost the same way: a tracker's poses drift.
PROBES, GAPS, STAND, LOOK, PLACES, FEWEST_PLACES, SMOOTH = 8, (1, 2, 4, 8), 0.15, 0.9, 400, 60, 1.05
# Depth is tried so many times as large, and farther by so many times the middle depth. It is wrong
# where another is so far from it, and correlates so much better in so many pairs; the photographs
# are where so many pairs correlate by less. On three recordings they do by 0.7 to 0.99 in the
# middle of the pairs, and no other depth does better; mirrored, turned or of others by 0.5 at most.
TIMES, AHEAD = np.geomspace(0.6, 1 / 0.6, 61), np.linspace(-0.5, 0.5, 61)
OTHER, GAIN, PAIRS, FEWEST_PAIRS, ALIKE = 0.06, 0.012, 0.6, 3, 0.52


def depth_findings(scene: Scene) -> list[Finding]:
    """A warning when depth does not agree with neighbours' depth, its pictures or the poses."""
    numbers = [number for number, view in enumerate(scene.views) if view.has_depth]
    if len(numbers) < 2:
        return []
    return unit_findings(scene, numbers) or _displaced(scene, numbers) or _unlike(scene, numbers)


def _displaced(scene: Scene, numbers: Sequence[int]) -> list[Finding]:
    """A warning when ends of surfaces lie beside the pictures' edges, alike in most views."""
    ends = np.linspace(0, len(numbers) - 1, min(VIEWS, len(numbers))).astype(int)
    frames = [frame_there(scene, numbers[at]) for at in ends]
    found = [_edges(frame) for frame in frames if frame is not None and frame.depth is not None]
    found = [(at, k) for at, k in found if len(at) >= FEWEST and k.shape == found[0][1].shape]
    if len(found) < FEWEST_VIEWS:
        return []
    places = np.concatenate([at for at, _ in found])
    view = np.repeat(range(len(found)), [len(at) for at, _ in found])
    pictures = np.array([edges for _, edges in found])
    size = np.array(pictures.shape[:1:-1])
    off, axis, ahead = places[:, :2] - size / 2, places[:, 2].astype(int), places[:, 3:]

    def strengths(move: Float64, flip: tuple[int, int] = (1, 1)) -> Float64:
        moved = flip * off * (1 + move[2]) + (move[:2] + move[3] * ahead) * size.max()
        return sampled(pictures, size / 2 + moved, view, axis)

    def score(move: Float64, flip: tuple[int, int] = (1, 1)) -> float:
        there = strengths(move, flip)
        return float(np.nanmean(there)) if np.isfinite(there).mean() > 0.5 else 0.0

    moves = [np.array([x, y, larger, 0]) for larger, x, y in product(SIZES, SHIFTS, SHIFTS)]
    scores = [score(move) for move in moves]
    best, move = climbed(score, moves[int(np.argmax(scores))], STEPS)
    flipped, way = max((score(np.zeros(4), flip), way) for way, flip in FLIPS.items())
    if flipped > max(BETTER * best, CLEAR * np.median(scores)):
        line = f"recorded depth is {way} against its pictures: their edges are where it ends then"
        return [Finding("warning", f"{line}; give both as one camera has them")]
    # Maps whose near surfaces are a little too wide or narrow, as stereo has them, are in place.
    now, still = max((score(still), tuple(still)) for still in GROWN)
    gain = strengths(move) - strengths(np.array(still))
    gained = [np.nanmean(gain[view == k]) > 0 for k in range(len(found))]
    away = np.linalg.norm(off * move[2] + move[:2] * size.max(), axis=1).mean() / size.max()
    clear = best > max(BETTER * now, CLEAR * np.median(scores))
    if not clear or away < FAR or np.mean(gained) < PAIRS:
        return []
    camera = scene.views[numbers[0]].camera
    right, down = move[:2] * max(camera.width[0], camera.height[0])
    line = (
        f"recorded depth is displaced against its pictures: their edges are {best / now - 1:.0%} "
        f"stronger where it ends if maps are moved right by {right:.0f} and down by {down:.0f} "
        f"pixels and are {1 + move[2]:.3g} times as large; of a depth camera of its own, give "
        "intrinsics and place (depth_K and color_from_depth in rgbd.json), else give maps "
        "registered to the pictures of the same moment"
    )
    return [Finding("warning", line)]


def _edges(frame: Frame) -> tuple[Float64, NDArray[np.float32]]:
    """(N, 5) places where depth ends, the axis, the way behind; (2, H, W) the picture's edges."""
    assert frame.depth is not None
    times = min(1.0, SIDE / max(frame.depth.shape))
    size = [max(2, round(side * times)) for side in frame.depth.shape[::-1]]
    depth = cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST)
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    places, edges = [], []
    for axis in (0, 1):
        beside = [np.take(depth, range(k, depth.shape[axis] - 1 + k), axis) for k in (0, 1)]
        near, far = np.sort(beside, axis=0)
        y, x = np.nonzero((near > 0) & (far > (1 + JUMP) * near))
        ahead = np.eye(2)[1 - axis] * np.sign(beside[1] - beside[0])[y, x, None]
        places.append(np.column_stack([x + (1 + axis) / 2, y + 1 - axis / 2, 0 * x + axis, ahead]))
        step = np.abs(np.asarray(cv2.Sobel(grey, cv2.CV_32F, axis, 1 - axis), np.float32))
        around = cv2.GaussianBlur(step, (0, 0), SIDE / 32) + 4
        edges.append(cv2.blur(np.minimum(step / around, STRONGEST), (3, 3)))
    found = np.concatenate(places)
    chosen = np.linspace(0, len(found) - 1, min(EDGES, len(found))).astype(int)
    return found[chosen], np.array(edges)


def _unlike(scene: Scene, numbers: Sequence[int]) -> list[Finding]:
    """A warning when views are not alike where depth places them, or more so by other depth."""
    load = lru_cache(1 + len(GAPS))(partial(frame_there, scene))
    pairs = list[tuple[Any, ...]]()
    for at in sorted({*np.linspace(0, len(numbers) - 1, PROBES).astype(int).tolist()}):
        frame, camera = load(numbers[at]), scene.views[numbers[at]].camera
        if frame is None or frame.depth is None:
            continue
        y, x = _detailed(frame.rgb, frame.depth)
        pose, z = camera.world_from_cam[0], frame.depth[y, x].astype(float)
        rays = camera.rays()[y, x] @ pose[:3, :3].T
        for other in (numbers[at + gap] for gap in GAPS if at + gap < len(numbers)):
            there, beside = load(other), scene.views[other].camera
            moved = np.linalg.norm(beside.centers[0] - pose[:3, 3])
            turned = beside.cam_from_world[0, 2, :3] @ pose[:3, 2]
            near = 0 < moved < STAND * np.median([*z, 0]) and turned > LOOK
            if there is not None and near:
                picture = np.clip(shown(there.rgb), -127, 127).astype(np.int8)
                pairs.append((pose[:3, 3], rays, z, shown(frame.rgb)[y, x], beside, picture))
    middle = float(np.median(np.concatenate([[1.0], *(pair[2] for pair in pairs)])))

    def alike(times: float, ahead: float) -> Float64:
        """(P,) correlation of what pairs show at the same places, depth so changed; 0 for few."""
        found = np.zeros(len(pairs))
        for row, (center, rays, z, own, beside, picture) in enumerate(pairs):
            places = center + rays * (times * z + ahead * middle)[:, None]
            (xy,), (depth,) = beside.project(places)
            there = sampled(picture, np.where(depth[:, None] > 0, xy, -1))
            seen = np.isfinite(there)
            if seen.sum() >= FEWEST_PLACES and own[seen].std() > CONTRAST < there[seen].std():
                found[row] = np.corrcoef(own[seen], there[seen])[0, 1]
        return found

    pairs = [pair for pair, known in zip(pairs, alike(1, 0), strict=True) if known]
    if len(now := alike(1, 0)) < FEWEST_PAIRS:
        return []
    tried = [[alike(times, 0) for times in TIMES], [alike(1, ahead) for ahead in AHEAD]]
    rows = [int(np.argmax(np.mean(found, axis=1))) for found in tried]
    fits = [found[row] for found, row in zip(tried, rows, strict=True)]
    means, before = [float(fit.mean()) for fit in fits], float(now.mean())
    times, ahead = float(TIMES[rows[0]]), float(AHEAD[rows[1]])
    other = min(abs(times - 1), abs(ahead)) > OTHER and max(means) > max(before + GAIN, ALIKE)
    if other and (fits[means[1] > means[0]] > now).mean() > PAIRS:
        line = (
            f"recorded depth contradicts the poses: pictures of neighbouring views agree where it "
            f"places them (correlation {before:.2f}), but more if it were {times:.3g} times as "
            f"large ({means[0]:.2f}) or {ahead * middle:+.3g} farther ({means[1]:.2f}): mend the "
            "unit or the constant of one of them (--depth-unit of RGB-D folders, "
            "depth_unit_scale_factor or integer_depth_scale of transforms.json)"
        )
        return [Finding("warning", line)]
    if np.median(now) > ALIKE:
        return []
    line = (
        f"photographs do not show the same places by depth: neighbours correlate by "
        f"{np.median(now):.2f}, expected more than {ALIKE:g} (renumbered, mirrored?): {GIVE}"
    )
    return [Finding("warning", line)]


def _detailed(
    rgb: NDArray[np.uint8], depth: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of pixels with detail around which depth is smooth, evenly spread."""
    low, high = (edge(depth, np.ones((5, 5), np.uint8)) for edge in (cv2.erode, cv2.dilate))
    strength = np.abs(detail(rgb)) * ((low > 0) & (high < SMOOTH * low))
    found = np.argwhere(strength > np.quantile(strength[low > 0], 0.75) if low.any() else low)
    y, x = found[np.linspace(0, len(found) - 1, min(PLACES, len(found))).astype(int)].T
    return y, x
