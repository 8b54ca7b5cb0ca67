"""Poses of an RGB-D recording: registered pairs of frames, loop closures, and a pose graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import invert_rigid
from gvtools.poses.motions import (
    Pair,
    chain_motions,
    connected_parts,
    first_poses,
    optimise,
    residual,
    within,
)
from gvtools.poses.odometry import RgbdFrames, compare, start_from_features

Float64 = NDArray[np.float64]

# Neighbours whose agreement is below this are registered from other initial poses, too: at a wrong
# local minimum two thirds of the pixels can agree.
SURE = 0.9
# Every n-th frame is also registered to the one n before it.
GAPS = (2, 4, 8, 16, 32)
# A new keyframe after so much motion since the last one [m, degrees].
KEY_SHIFT, KEY_TURN = 0.08, 5.0
# Loop closures are tried between a keyframe and the ALIKE others that look most like it, and the
# NEAR ones of nearest pose,
ALIKE, NEAR = 6, 4
# of those within this [m, degrees].
NEAR_SHIFT, NEAR_TURN = 0.6, 30.0
# How often loops by pose are looked for, each time with the poses optimised so far.
ROUNDS = 2

Say = Callable[[str], object]


@dataclass(frozen=True, eq=False)
class RecordingPoses:
    """Poses of the largest connected part of a recording."""

    # (4, 4) ``world_from_cam`` by frame, metres; the first frame's is the identity.
    poses: dict[int, Float64]
    # Frames of each connected part, the largest first.
    parts: list[list[int]]
    # All that agreed, and loop closures: those of the largest part that are no neighbours along
    # the path.
    pairs: list[Pair]
    loops: list[Pair]
    # (L, 2) errors of loops [mm, degrees] if neighbouring pairs are simply chained; loops across a
    # break of the chain have no row.
    drift: Float64
    # (loops, 2) their errors after optimisation [mm, degrees].
    residuals: Float64
    keyframes: list[int]


def find_poses(frames: RgbdFrames, *, say: Say = lambda text: None) -> RecordingPoses:
    """Find the poses of frames in order of time; ``say`` gets a line of text at each step."""
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
    return RecordingPoses(
        poses,
        connected_parts(len(frames), list(pairs.values())),
        list(pairs.values()),
        loops,
        _drift(loops, chain),
        np.array([residual(pair, poses) for pair in loops]).reshape(-1, 2),
        keyframes,
    )


def _solve(count: int, pairs: list[Pair]) -> tuple[list[int], dict[int, Float64]]:
    """The largest connected part and its poses."""
    part = connected_parts(count, pairs)[0]
    inside = set(part)
    own = sorted(
        (pair for pair in pairs if pair.source in inside),
        key=lambda pair: (abs(pair.source - pair.target), pair.source),
    )
    poses = first_poses(part, own)
    return part, optimise({frame: poses[frame] for frame in part}, own) if own else poses


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
            start = chain_motions(step.target_from_source for step in steps if step is not None)
            far = compare(frames, at, at - gap, start=start)
            if far is None:
                break
            pairs[at, at - gap] = far
    return pairs


def _next(frames: RgbdFrames, at: int, motion: Float64) -> Pair | None:
    """The pair of a frame and the one before it, from the initial pose that gives the best result.

    Tried in this order until one is ``_sure``: the motion before, no motion, and PnP on features.
    """
    best = compare(frames, at, at - 1, start=motion)
    if not _sure(best) and not np.array_equal(motion, np.eye(4)):
        best = _better(best, compare(frames, at, at - 1, start=np.eye(4)))
    if not _sure(best):
        best = _better(best, _compare_by_features(frames, at, at - 1))
    return best


def _sure(pair: Pair | None) -> bool:
    return pair is not None and pair.agreement >= SURE


def _better(first: Pair | None, second: Pair | None) -> Pair | None:
    pairs = [pair for pair in (first, second) if pair is not None]
    return max(pairs, key=lambda pair: pair.agreement, default=None)


def _compare_by_features(frames: RgbdFrames, source: int, target: int) -> Pair | None:
    """The pair of two frames whose initial pose comes from matched features."""
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
    """Add loop closures between keyframes that look alike."""
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
        pair = _compare_by_features(frames, source, target)
        if pair is not None:
            pairs[source, target] = pair


def _loops_near(
    frames: RgbdFrames,
    keyframes: list[int],
    pairs: dict[tuple[int, int], Pair],
    *,
    poses: dict[int, Float64],
) -> None:
    """Add loop closures between keyframes whose poses are near each other."""
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
    """(L, 2) errors [mm, degrees] of loops on chained poses, where the chain has no break."""
    rows = []
    for pair in loops:
        steps = [chain.get(at) for at in range(pair.source, pair.target, -1)]
        if any(step is None for step in steps):
            continue
        pose = chain_motions(step.target_from_source for step in steps if step is not None)
        rows.append(residual(pair, {pair.source: pose, pair.target: np.eye(4)}))
    return np.array(rows).reshape(-1, 2)
