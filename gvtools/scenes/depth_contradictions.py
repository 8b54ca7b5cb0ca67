"""Recorded depth that contradicts the poses, its neighbours or its pictures.

Neighbours' depth tells of a wrong unit and of other frames' maps, but not where all maps are wrong
alike: displaced, of another lens, too far or too near. Then pictures tell, which mostly have edges
where surfaces end; and what a view shows is seen in others where depth and poses place it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache, partial
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.scenes import pixel_contradictions as pixel
from gvtools.scenes.images import Depth
from gvtools.scenes.pixel_contradictions import Float64, climbed, frame_there, sampled
from gvtools.scenes.scene import Finding, Frame, Scene

# Factors that depth may lack, a tenth apart, near 1 a hundredth, and how far depths that agree may
# differ.
FACTORS, SAME = np.append(10 ** (np.arange(-96, 97) / 24), np.geomspace(0.5, 2, 141)), 0.01
# Views that are compared with those so many places after them, and pixels of each.
PROBES, GAPS, PIXELS = 4, (1, 4, 16), 800
# Depth is wrong when another factor makes so many agree, and of the two pairs that tell most, depth
# as it is has less than these shares of each one's best. On three recordings it is 0.9 or more.
AGREE, SHARES, FAR = 0.2, (0.75, 0.92), 1.13
# As distances along the rays it agrees when this share of that is more than any factor's; and pairs
# that tell have this share of their best at the factor that is best for all.
SHARE = 0.8
# Of so many pixels that a second view does not hide, so few that are nearly alike in one pair, or
# two, tell of maps that are not of their cameras. On seven recordings it is 0.92 at the least, and
# 0.1 to 0.3 of mirrored maps and those of other frames; what moves takes a part of it away.
NEARLY, LEAST, ONE_PAIR, TWO_PAIRS = 0.05, 100, 0.3, 0.6
# Maps are those of the next frames, or of those before, when so much of them then agrees within the
# first share, in the middle of the pairs, and less as they are. On three recordings it is 0.98.
CLOSE, FITTING = 0.02, 0.93
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
ASIDE, BETTER, CLEAR = 0.006, 1.12, 1.6
# Views of which places, where depth is smooth, are sought in those so many after them that stand
# within a share of the depth and look almost the same way: a tracker's poses drift.
BEGIN, LATER, STAND, LOOK = 8, (1, 2, 4, 8), 0.15, 0.9
PLACES, FEWEST_PLACES, SMOOTH = 400, 60, 1.05
# Depth is tried so many times as large, and farther by so many times the middle depth. It is wrong
# where another is so far from it, and correlates so much better in so many pairs; the photographs
# are where so many pairs correlate by less. On three recordings they do by 0.7 to 0.99 in the
# middle of the pairs, and no other depth does better; mirrored, turned or of others by 0.5 at most.
TIMES, AHEAD = np.geomspace(0.6, 1 / 0.6, 61), np.linspace(-0.5, 0.5, 61)
OTHER, GAIN, PAIRS, FEWEST_PAIRS, ALIKE = 0.06, 0.012, 0.6, 3, 0.52

Pair = tuple[Depth, Depth, tuple[Cameras, Cameras]]


def unit_findings(scene: Scene, numbers: Sequence[int]) -> list[Finding]:
    """A warning when depth of neighbours does not agree with the poses; views by ``numbers``."""
    first = sorted({*np.linspace(0, len(numbers) - 1, PROBES).astype(int).tolist()})
    frame_of = cache(partial(frame_there, scene))
    pairs = [(at, at + gap) for at in first for gap in GAPS if at + gap < len(numbers)]

    def compared_with(step: int) -> dict[str, Pair]:
        """The pairs that move, with depth of so many places after them."""
        found = {}
        for pair in pairs:
            a, b = (scene.views[numbers[place]] for place in pair)
            there = [numbers[p + step] for p in pair if 0 <= p + step < len(numbers)]
            depths = [frame.depth for number in there if (frame := frame_of(number))]
            one, other = depths if len(depths) == 2 else (None, None)
            moved = np.linalg.norm(a.camera.centers - b.camera.centers) > 0
            if one is not None and other is not None and moved:
                found[f"{a.name} and {b.name}"] = one, other, (a.camera, b.camera)
        return found

    of_names = compared_with(0)
    names, compared = [*of_names], [*of_names.values()]
    if not compared:
        return []
    now, agreeing = (_agreeing(compared, at)[0] for at in (np.ones(1), FACTORS))
    mean, most = agreeing.mean(0), agreeing.max(1)
    best, factor = mean.max(), float(FACTORS[mean.argmax()])
    ratios = np.where(most < AGREE, 1, now[:, 0] / np.maximum(most, AGREE))
    telling = np.argsort(ratios)[:2]
    fits = agreeing[telling, mean.argmax()] > SHARE * most[telling]
    wrong_unit = fits.all() and (ratios[telling] < SHARES[: len(telling)]).all()
    agreed, shared = (part[:, 0] for part in _agreeing(compared, np.ones(1), same=NEARLY))
    shares = np.where(shared * PIXELS < LEAST, np.nan, agreed / np.maximum(shared, 1e-9))
    close = {0: _close(compared)}
    if close[0] < FITTING:
        close |= {step: _close([*compared_with(step).values()]) for step in (1, -1)}
    late = max(close, key=lambda step: close[step] if step and close[step] > FITTING else close[0])
    straight = [(_of_rays(one, a), _of_rays(other, b), (a, b)) for one, other, (a, b) in compared]
    by_rays = SHARE * _agreeing(straight, np.ones(1))[0].mean() > max(best, AGREE)
    if not by_rays and wrong_unit and best >= AGREE and max(factor, 1 / factor) > FAR:
        times = f"{float(f'{factor:.3g}'):g}"
        line = (
            f"recorded depth contradicts the poses: {now.mean():.0%} of neighbouring views' depth "
            f"agrees, {best:.0%} if depth were {times} times as large; the unit of one of them is "
            "wrong: state that of depth (--depth-unit of RGB-D folders, depth_unit_scale_factor or "
            "integer_depth_scale of transforms.json) or give poses in the same unit"
        )
        return [Finding("warning", line)]
    known = np.sort(shares[np.isfinite(shares)])
    if not len(known) and len(names) > len(telling):
        line = f"no place of {len(names)} pairs of views (first {names[0]}) is seen by both"
        line = f"recorded depth contradicts the poses: {line}: state its unit (--depth-unit)"
        return [Finding("warning", line)]
    wrong = (known[:1] < ONE_PAIR).any() or (known[1:2] < TWO_PAIRS).any()
    if not (by_rays or wrong or late):
        return []
    reason = "; it fits as distances along the rays" if by_rays else ""
    if late and not by_rays:
        beside = "before" if late > 0 else "after"
        reason = (
            f"; each map fits the frame {beside} its own ({close[late]:.0%} then agrees within "
            f"{CLOSE:.0%}, {close[0]:.0%} now)"
        )
    which = names[int(np.nanargmin(shares))]
    line = (
        f"recorded depth contradicts the poses: {np.nanmin(shares):.0%} of the places that {which} "
        f"show agrees within {NEARLY:.0%}{reason}; expected z-depth in one unit, of frame and "
        "camera that it is named after: are maps mirrored, of other frames or another byte order?"
    )
    return [Finding("warning", line)]


def _close(pairs: Sequence[Pair]) -> float:
    """The share of what both of a pair show that nearly agrees, in the middle of pairs."""
    if not pairs:
        return 0.0
    agreed, shared = (part[:, 0] for part in _agreeing(pairs, np.ones(1), same=CLOSE))
    told = shared * PIXELS >= LEAST
    return float(np.median(agreed[told] / shared[told])) if told.any() else 0.0


def _of_rays(depth: Depth, camera: Cameras) -> Depth:
    """(H, W) z-depth of distances along the rays."""
    return np.asarray(depth / np.linalg.norm(camera.rays(), axis=-1), np.float32)


def _agreeing(
    pairs: Sequence[Pair], factors: Float64, *, same: float = SAME
) -> tuple[Float64, Float64]:
    """(P, F) shares of first views' pixels that agree at each factor, and that seconds show."""
    agreed, shared = np.zeros((2, len(pairs), len(factors)))
    for row, (one, other, cameras) in enumerate(pairs):
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
        there = sampled(other, np.where(z[..., None] > 0, xy, -1).reshape(-1, 2)).reshape(z.shape)
        inside, expected = np.isfinite(there), factors[:, None] * np.nan_to_num(there)
        # What is hidden tells nothing.
        inside &= expected * (1 + same) > z
        shared[row] = inside.sum(1) / max(len(rows), 1)
        agreed[row] = (inside & (np.abs(z - expected) < same * expected)).sum(1) / max(len(rows), 1)
    return agreed, shared


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
    if not clear or away < ASIDE or np.mean(gained) < PAIRS:
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
    load = lru_cache(1 + len(LATER))(partial(frame_there, scene))
    pairs = list[tuple[Any, ...]]()
    for at in sorted({*np.linspace(0, len(numbers) - 1, BEGIN).astype(int).tolist()}):
        frame, camera = load(numbers[at]), scene.views[numbers[at]].camera
        if frame is None or frame.depth is None:
            continue
        y, x = _detailed(frame.rgb, frame.depth)
        pose, z = camera.world_from_cam[0], frame.depth[y, x].astype(float)
        rays = camera.rays()[y, x] @ pose[:3, :3].T
        for other in (numbers[at + gap] for gap in LATER if at + gap < len(numbers)):
            there, beside = load(other), scene.views[other].camera
            moved = np.linalg.norm(beside.centers[0] - pose[:3, 3])
            turned = beside.cam_from_world[0, 2, :3] @ pose[:3, 2]
            near = 0 < moved < STAND * np.median([*z, 0]) and turned > LOOK
            if there is not None and near:
                picture = np.clip(pixel.shown(there.rgb), -127, 127).astype(np.int8)
                pairs.append((pose[:3, 3], rays, z, pixel.shown(frame.rgb)[y, x], beside, picture))
    middle = float(np.median(np.concatenate([[1.0], *(pair[2] for pair in pairs)])))

    def alike(times: float, ahead: float) -> Float64:
        """(P,) correlation of what pairs show at the same places, depth so changed; 0 for few."""
        found = np.zeros(len(pairs))
        for row, (center, rays, z, own, beside, picture) in enumerate(pairs):
            places = center + rays * (times * z + ahead * middle)[:, None]
            (xy,), (depth,) = beside.project(places)
            there = sampled(picture, np.where(depth[:, None] > 0, xy, -1))
            seen = np.isfinite(there)
            if seen.sum() >= FEWEST_PLACES and own[seen].std() > pixel.CONTRAST < there[seen].std():
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
        f"{np.median(now):.2f}, expected more than {ALIKE:g} (renumbered, mirrored?): {pixel.GIVE}"
    )
    return [Finding("warning", line)]


def _detailed(
    rgb: NDArray[np.uint8], depth: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of pixels with detail around which depth is smooth, evenly spread."""
    low, high = (edge(depth, np.ones((5, 5), np.uint8)) for edge in (cv2.erode, cv2.dilate))
    strength = np.abs(pixel.detail(rgb)) * ((low > 0) & (high < SMOOTH * low))
    found = np.argwhere(strength > np.quantile(strength[low > 0], 0.75) if low.any() else low)
    y, x = found[np.linspace(0, len(found) - 1, min(PLACES, len(found))).astype(int)].T
    return y, x
