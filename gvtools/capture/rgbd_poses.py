"""Poses of an RGB-D recording: pairs along the path, loops by appearance, one pose graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.capture.odometry import Pair, chained, compare, start_from_features, within
from gvtools.capture.pose_graph import connected, first_poses, optimised, residual
from gvtools.capture.rgbd_frames import RgbdFrames

Float64 = NDArray[np.float64]

# A pair of neighbours that agrees by less is started in other ways, too: a pair that has run into a
# wrong place can agree in two thirds of its pixels.
SURE = 0.9
# A frame is compared with those so many before it; every n-th with the one n before.
GAPS = (2, 4, 8, 16, 32)
# A new keyframe after so much motion [m, degrees].
KEY_SHIFT, KEY_TURN = 0.08, 5.0
# A keyframe is compared with so many of those that look most like it, or are near by their poses.
ALIKE, NEAR = 6, 4
# Near: within these [m, degrees].
NEAR_SHIFT, NEAR_TURN = 0.6, 30.0
# Rounds of looking for loops near by the poses of the round before.
ROUNDS = 2

Say = Callable[[str], object]


@dataclass(frozen=True, eq=False)
class Found:
    """Poses of the largest connected part.

    Attributes:
        poses: (4, 4) ``world_from_cam`` by frame, metres; the first frame's is the identity.
        parts: frames of each connected part, the largest first.
        pairs: all that agreed.
        loops: pairs that close loops, of the largest part.
        drift: of these, by how much the chain along the path departed: (L, 2) mm and degrees.
        residuals: the same after optimisation.
        keyframes: numbers of the keyframes.
    """

    poses: dict[int, Float64]
    parts: list[list[int]]
    pairs: list[Pair]
    loops: list[Pair]
    drift: Float64
    residuals: Float64
    keyframes: list[int]


def find_poses(frames: RgbdFrames, *, say: Say = lambda text: None) -> Found:
    """Find the poses of a recording's frames.

    Args:
        frames: in order of time.
        say: told of each step.

    Raises:
        ProjectError: a file is unreadable.
    """
    pairs = _along(frames, say)
    chain = {pair.source: pair for pair in pairs.values() if pair.source - pair.target == 1}
    keyframes = _keyframes(len(frames), chain)
    path = list(pairs.values())
    _loops_alike(frames, keyframes, pairs, say=say)
    poses: dict[int, Float64] = {}
    for _ in range(ROUNDS):
        part, poses = _solve(len(frames), list(pairs.values()))
        before = len(pairs)
        _loops_near(frames, [key for key in keyframes if key in poses], pairs, poses=poses)
        if len(pairs) == before:
            break
    part, poses = _solve(len(frames), list(pairs.values()))
    inside = set(part)
    ends = {id(pair) for pair in path}
    loops = [
        pair
        for pair in pairs.values()
        if id(pair) not in ends and {pair.source, pair.target} <= inside
    ]
    return Found(
        poses,
        connected(len(frames), list(pairs.values())),
        list(pairs.values()),
        loops,
        _drift(loops, chain),
        np.array([residual(pair, poses) for pair in loops]).reshape(-1, 2),
        keyframes,
    )


def _solve(count: int, pairs: list[Pair]) -> tuple[list[int], dict[int, Float64]]:
    """The largest connected part and its poses."""
    part = connected(count, pairs)[0]
    inside = set(part)
    own = sorted(
        (pair for pair in pairs if pair.source in inside),
        key=lambda pair: (abs(pair.source - pair.target), pair.source),
    )
    poses = first_poses(part, own)
    return part, optimised(part, own, start=poses) if own else poses


def _along(frames: RgbdFrames, say: Say) -> dict[tuple[int, int], Pair]:
    """Pairs of neighbours in time, and of frames farther apart along the path."""
    pairs: dict[tuple[int, int], Pair] = {}
    motion = np.eye(4)
    for at in range(1, len(frames)):
        if at % 100 == 0:
            say(f"{at} of {len(frames)} frames compared")
        pair = _next(frames, at, motion)
        motion = np.eye(4) if pair is None else pair.target_from_source
        if pair is None:
            continue
        pairs[at, at - 1] = pair
        for gap in GAPS:
            if at % gap:
                break
            steps = [pairs.get((row, row - 1)) for row in range(at, at - gap, -1)]
            if at < gap or any(step is None for step in steps):
                break
            start = chained(step.target_from_source for step in steps if step is not None)
            far = compare(frames, at, at - gap, start=start)
            if far is None:
                break
            pairs[at, at - gap] = far
    return pairs


def _next(frames: RgbdFrames, at: int, motion: Float64) -> Pair | None:
    """A frame and the one before: the best of what its possible starts lead to.

    The camera goes on as it went, or stands still, or is recognised by its features.
    """
    best = compare(frames, at, at - 1, start=motion)
    if not _sure(best) and not np.array_equal(motion, np.eye(4)):
        best = _better(best, compare(frames, at, at - 1, start=np.eye(4)))
    if not _sure(best):
        best = _better(best, _recognised(frames, at, at - 1))
    return best


def _sure(pair: Pair | None) -> bool:
    return pair is not None and pair.agreement >= SURE


def _better(first: Pair | None, second: Pair | None) -> Pair | None:
    pairs = [pair for pair in (first, second) if pair is not None]
    return max(pairs, key=lambda pair: pair.agreement, default=None)


def _recognised(frames: RgbdFrames, source: int, target: int) -> Pair | None:
    start = start_from_features(frames.features(source), frames.features(target), frames.feature_K)
    return None if start is None else compare(frames, source, target, start=start)


def _keyframes(count: int, chain: dict[int, Pair]) -> list[int]:
    """Frames after enough motion, and on both sides of each break of the path."""
    keys, pose = [0], np.eye(4)
    for at in range(1, count):
        if at not in chain:
            keys += [at - 1] * (keys[-1] != at - 1) + [at]
            pose = np.eye(4)
            continue
        pose = pose @ chain[at].target_from_source
        if not within(pose, KEY_SHIFT, KEY_TURN):
            keys.append(at)
            pose = np.eye(4)
    if keys[-1] != count - 1:
        keys.append(count - 1)
    return keys


def _loops_alike(
    frames: RgbdFrames, keyframes: list[int], pairs: dict[tuple[int, int], Pair], *, say: Say
) -> None:
    """Add pairs of keyframes that look alike and agree."""
    say(f"looking for loops among {len(keyframes)} keyframes")
    if len(keyframes) < 2:
        return
    thumbnails = np.stack([frames.features(key).thumbnail for key in keyframes])
    likeness = thumbnails @ thumbnails.T
    np.fill_diagonal(likeness, -np.inf)
    wanted = set()
    for row, key in enumerate(keyframes):
        # Neighbours among keyframes are tried as well: they may lie on two sides of a break.
        near = [other for other in (row - 2, row - 1) if other >= 0]
        alike = np.argsort(-likeness[row], kind="stable")[: min(ALIKE, len(keyframes) - 1)]
        for other in [*near, *alike.tolist()]:
            wanted.add((max(key, keyframes[other]), min(key, keyframes[other])))
    for source, target in sorted(wanted - set(pairs)):
        pair = _recognised(frames, source, target)
        if pair is not None:
            pairs[source, target] = pair


def _loops_near(
    frames: RgbdFrames,
    keyframes: list[int],
    pairs: dict[tuple[int, int], Pair],
    *,
    poses: dict[int, Float64],
) -> None:
    """Add pairs of keyframes that are near by their poses and agree."""
    for row, source in enumerate(keyframes):
        near = []
        for target in keyframes[:row]:
            start = invert_rigid(poses[target]) @ poses[source]
            if (source, target) not in pairs and within(start, NEAR_SHIFT, NEAR_TURN):
                near.append((float(np.linalg.norm(start[:3, 3])), target, start))
        for _, target, start in sorted(near, key=lambda item: item[:2])[:NEAR]:
            pair = compare(frames, source, target, start=start)
            if pair is not None:
                pairs[source, target] = pair


def _drift(loops: list[Pair], chain: dict[int, Pair]) -> Float64:
    """Residuals of loops on the poses that pairs of neighbours alone give, where they do."""
    rows = []
    for pair in loops:
        steps = [chain.get(at) for at in range(pair.source, pair.target, -1)]
        if any(step is None for step in steps):
            continue
        pose = chained(step.target_from_source for step in steps if step is not None)
        rows.append(residual(pair, {pair.source: pose, pair.target: np.eye(4)}))
    return np.array(rows).reshape(-1, 2)
