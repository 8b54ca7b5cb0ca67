"""Recorded depth that contradicts the poses, by its unit or else: neighbours' depth tells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import GvError
from gvtools.scenes.images import Depth
from gvtools.scenes.scene import Finding, Frame, Scene

Float64 = NDArray[np.float64]

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
# Steps of one length at most, in a search for what fits better.
CLIMBS = 8

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


def climbed(
    score: Callable[[Float64], float], start: Float64, steps: Sequence[float], *, gain: float = 0.0
) -> tuple[float, Float64]:
    """The best score and its place: ever smaller steps along an axis, each worth a gain."""
    best, place = score(start), start
    for step in steps:
        for _ in range(CLIMBS):
            tried = [place + way * step for unit in np.eye(len(place)) for way in (unit, -unit)]
            scores = [score(other) for other in tried]
            if max(scores) <= best + gain:
                break
            best, place = max(scores), tried[int(np.argmax(scores))]
    return best, place


def sampled(picture: NDArray[Any], xy: Float64, *of: NDArray[np.int64]) -> Float64:
    """(N,) numbers of (..., H, W) pictures, ``of`` which, at places (N, 2); NaN outside."""
    with np.errstate(invalid="ignore"):
        inside = ((xy >= 0) & (xy < picture.shape[:-3:-1])).all(1)
    x, y = np.floor(xy[inside]).astype(np.int64).T
    found = np.full(len(xy), np.nan)
    found[inside] = picture[(*(each[inside] for each in of), y, x)]
    return found


def frame_there(scene: Scene, number: int) -> Frame | None:
    """A view's pixels; None where they cannot be read, which is said elsewhere."""
    try:
        return scene.views[number].load()
    except GvError:
        return None


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
