"""Poses that contradict the photographs of scenes without tracks: other axes, inverted, shuffled.

Matches of two pictures that fit one epipolar geometry, whichever it is, show the same places. So
most of them lie on the epipolar lines of the given poses, too, and in front of both cameras, unless
these are of another form. Of cameras that go sideways the lines alone do not tell axes apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.features import Features, SiftMatcher
from gvtools.scenes.calibration import OPENCV_FROM_OPENGL
from gvtools.scenes.pixel_contradictions import climbed, frame_there
from gvtools.scenes.scene import Finding, Scene
from gvtools.trajectory_files import reordered

Float64 = NDArray[np.float64]

# Pairs that are compared, by how many views they are apart, the pictures' longer side [pixels].
PAIRS, STEPS, SIDE = 4, (1, 2, 4), 480
# Matches lie on their lines below this distance [pixels], and fit a geometry of their own below
# the second; a pair has so many at least, and moves by more than this share of the longer side.
NEAR, OWN, MATCHES, MOTION = 2.5, 1.2, 40, 0.02
# Poses are wrong below this share of matches on their lines, other forms are right above it; on
# real scenes it is 0.9 and more in the middle of the pairs. So many matches are needed in all.
WRONG, RIGHT = 0.52, 0.7
JUDGED = 120
# Changes of the focal length and of k1 that are tried, too, from the best of some focal lengths on,
# by these steps. Where the best change is large and makes nearly all matches fit, of cropped
# pictures and wrong distortion, without it less than a share of that does; on real scenes it is
# 0.98, of a tracker's poses 0.85 with changes of less than 0.08.
LONGER, STEPS_OF_LENS, GAIN = (0.7, 0.8, 0.9, 1.1, 1.25, 1.45), (0.16, 0.08, 0.04), 0.005
FITS, BENT, LARGE = 0.9, 0.82, 0.1
# Views whose focal length differs by more than this share from the usual one may be wrong alone.
UNUSUAL = 0.02
# Views farther apart are not looked at where a pair moves by this share.
ENOUGH = 0.08
FLIP, NO_CHANGE = OPENCV_FROM_OPENGL, np.zeros(3)
MIRRORED = [np.outer(signs, signs) for signs in ((1, -1, 1, 1), (1, 1, -1, 1))]


def _reordered(pose: Float64, places: int) -> Float64:
    changed = pose.copy()
    changed[:3, :3] = reordered(pose[:3, :3], places)
    return changed


# What may have been written for cam_from_world, by what sets it right.
FORMS: Mapping[str, Callable[[Float64], Float64]] = {
    "cameras' axes as OpenCV and OpenGL have them were taken for each other (turn y and z over)": (
        lambda pose: FLIP @ pose
    ),
    "the matrices map the other way (invert them)": invert_rigid,
    "the matrices map the other way (invert them), with axes of OpenCV": (
        lambda pose: invert_rigid(pose) @ FLIP
    ),
    "the matrices map the other way (invert them), with axes of OpenGL": (
        lambda pose: FLIP @ invert_rigid(pose) @ FLIP
    ),
    "quaternions have the scalar last, where it is expected first": (
        lambda pose: _reordered(pose, 1)
    ),
    "quaternions have the scalar first, where it is expected last": (
        lambda pose: invert_rigid(_reordered(invert_rigid(pose), -1))
    ),
    "axes are left-handed (turn y of world and camera over)": lambda pose: pose * MIRRORED[0],
    "axes are left-handed (turn z of world and camera over)": lambda pose: pose * MIRRORED[1],
}


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two views, and the places of what both show, pixels of the views."""

    views: tuple[int, int]
    xy: tuple[Float64, Float64]  # (M, 2) each

    def share(
        self, K: Float64, poses: Float64, *, scale: Float64, near: float, k1: float = 0.0
    ) -> float:
        """How many of the matches lie on epipolar lines, and not clearly behind a camera."""
        a, b = self.views
        bent = []
        for view, xy in zip(self.views, self.xy, strict=True):
            off = xy - K[view, :2, 2]
            r2 = np.square(off / K[view, (0, 1), (0, 1)]).sum(1, keepdims=True)
            bent.append(xy + k1 * r2 * off)
        change = poses[1] @ np.linalg.inv(poses[0])
        x, y, z = shift = change[:3, 3]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        F = np.linalg.inv(K[b]).T @ cross @ change[:3, :3] @ np.linalg.inv(K[a])
        first, second = (np.column_stack([xy, np.ones(len(xy))]) for xy in bent)
        lines, back = first @ F.T, second @ F
        off = np.abs((second * lines).sum(1))
        far = off / np.maximum(np.minimum(*(np.hypot(*r.T[:2]) for r in (lines, back))), 1e-12)
        # Rays meet where m one + shift = n other, of which m and n have to be positive.
        one = first @ (change[:3, :3] @ np.linalg.inv(K[a])).T
        other = second @ np.linalg.inv(K[b]).T
        sine = np.cross(one, other) / np.linalg.norm(one, axis=1, keepdims=True)
        m, n = ((np.cross(ray, shift) * sine).sum(1) for ray in (other, one))
        apart = np.linalg.norm(sine, axis=1) / np.linalg.norm(other, axis=1)
        behind = (np.minimum(m, n) < 0) & (apart * K[b, 0, 0] * scale[b] > near)
        return float(((far * scale[b] < near) & ~behind).mean())


@dataclass(frozen=True, eq=False)
class PoseContradiction:
    """How photographs contradict poses, and which form of them they confirm."""

    message: str
    form: Callable[[Float64], Float64] | None  # changes a pose to what fits; None where none does


def pose_findings(
    scene: Scene, names: Sequence[str] | None = None, *, most_pairs: int = PAIRS
) -> list[Finding]:
    """A warning where the photographs of a scene without tracks contradict its poses."""
    found = pose_contradiction(scene, names, most_pairs=most_pairs)
    return [] if found is None else [Finding("warning", found.message)]


def pose_contradiction(
    scene: Scene, names: Sequence[str] | None = None, *, most_pairs: int = PAIRS, near: float = NEAR
) -> PoseContradiction | None:
    """How the photographs of a scene without tracks contradict its poses; None where they don't.

    Points that one view shows alone, as networks save them, tell nothing of poses.
    """
    chosen = [
        number for number, view in enumerate(scene.views) if names is None or view.name in names
    ]
    tracks = scene.points is not None and np.bincount(scene.points.point_index, minlength=1)
    if len(chosen) < 2 or np.max(tracks) > 1:
        return None
    cameras = scene.cameras
    scale = np.minimum(SIDE / np.maximum(cameras.width, cameras.height), 1)
    focal = cameras.K[:, 0, 0] * scale
    others = np.abs(focal[:, None] / focal[chosen] - 1) > UNUSUAL
    usual = focal[chosen[int(others[chosen].sum(0).argmin())]]
    odd = np.abs(focal / usual - 1) > UNUSUAL
    pairs = _pairs(scene, chosen, scale, odd=odd, most_pairs=most_pairs)
    poses = cameras.cam_from_world

    def share(
        form: Callable[[Float64], Float64] = np.asarray, lens: Float64 = NO_CHANGE, later: int = 0
    ) -> float:
        K = cameras.K.copy()
        K[:, (0, 1), (0, 1)] *= 1 + lens[0] + lens[2] * odd[:, None]
        moved = np.roll(poses, -later, axis=0)
        changed = [np.array([form(moved[view]) for view in pair.views]) for pair in pairs]
        found = (
            pair.share(K, both, scale=scale, near=near, k1=lens[1])
            for pair, both in zip(pairs, changed, strict=True)
        )
        return float(np.median([*found]))

    if sum(len(pair.xy[0]) for pair in pairs) < JUDGED:
        return None
    now = share()
    starts = [NO_CHANGE, *(axis * (times - 1) for times in LONGER for axis in np.eye(3)[::2])]
    nearest = max(starts, key=lambda start: share(lens=start))
    best, lens = climbed(partial(share, np.asarray), nearest, STEPS_OF_LENS, gain=GAIN)
    if now >= WRONG and (best < FITS or now >= BENT * best or np.abs(lens).max() < LARGE):
        return None
    way = f"focal lengths {lens[0]:+.0%}, k1 {lens[1]:+.2f}"
    if lens[2]:
        unusual = [scene.views[view].name for view in chosen if odd[view]]
        way = f"focal lengths of {len(unusual)} views, first {unusual[0]}, {lens[2]:+.0%}; {way}"
    tried = {reason: share(form) for reason, form in FORMS.items()}
    for later, which in ((1, "next one"), (-1, "one before")):
        tried[f"pictures are renumbered (each fits the pose of the {which})"] = share(later=later)
    form = max(tried, key=lambda reason: tried[reason])
    # A lens has numbers that are fitted, and fits a little better by these alone.
    if tried[form] < FITS * best:
        form = f"another lens fits, as of cropped pictures or wrong distortion ({way})"
        tried[form] = best
    fits = tried[form] > max(RIGHT, now)
    reason = f"; {form}: then it is {tried[form]:.0%}" if fits else ""
    first, second = (scene.views[view].name for view in pairs[0].views)
    line = (
        f"poses or intrinsics do not fit the photographs: {now:.0%} of the matches of "
        f"{len(pairs)} pairs (first {first} and {second}) lie where the cameras allow, expected "
        f"more than {BENT:.0%}{reason}"
    )
    return PoseContradiction(line, FORMS.get(form) if fits else None)


def _pairs(
    scene: Scene, chosen: Sequence[int], scale: Float64, *, odd: NDArray[np.bool_], most_pairs: int
) -> list[_Pair]:
    """A few pairs of views, evenly spread, that show the same from places apart."""
    matcher, features = SiftMatcher(max_features=1500), dict[int, Features | None]()
    pairs = []
    unlike = odd[chosen]
    starts = np.flatnonzero(np.diff(unlike)) if unlike.any() else np.arange(len(chosen) - 1)
    ends = np.linspace(0, len(starts) - 1, most_pairs).round().astype(int)
    for row in sorted({*starts[ends].tolist()}):
        found = None
        others = [row + step for step in STEPS if row + step < len(chosen)]
        for other in others:
            if unlike.any() and unlike[row] == unlike[other]:
                continue
            views = chosen[row], chosen[other]
            for view in views:
                if view not in features:
                    features[view] = _features(scene, view, scale[view], matcher=matcher)
            a, b = (features[view] for view in views)
            if a is None or b is None:
                break
            rows = matcher.match(a, b)
            xy = a.xy[rows[:, 0]], b.xy[rows[:, 1]]
            if len(rows) < MATCHES:
                break
            cv2.setRNGSeed(0)
            _, own = cv2.findFundamentalMat(*xy, cv2.FM_RANSAC, OWN, 0.999, 2000)
            kept = np.zeros(len(rows), np.bool_) if own is None else own[:, 0] > 0
            if kept.sum() < MATCHES:
                break
            moved = np.median(np.linalg.norm(xy[1] - xy[0], axis=1))
            if moved > MOTION * SIDE:
                scales = scale[views[0]], scale[views[1]]
                found = _Pair(views, (xy[0][kept] / scales[0], xy[1][kept] / scales[1]))
                if moved > ENOUGH * SIDE:
                    break
        if found is not None:
            pairs.append(found)
    return pairs


def _features(scene: Scene, view: int, scale: float, *, matcher: SiftMatcher) -> Features | None:
    """Features of a view's picture at the longer side SIDE; None where it cannot be read."""
    frame = frame_there(scene, view)
    if frame is None:
        return None
    size = tuple(max(1, round(side * scale)) for side in frame.rgb.shape[1::-1])
    reduced = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
    return matcher.extract(np.asarray(reduced, np.uint8))
