"""Camera paths through the free space of procedural scenes.

A path is drawn until all of its cameras stand free, see nothing too near and none stares at a wall;
what fails all attempts is replaced by a pan about the start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gvtools.cameras import Cameras, Float64, rigid_poses
from gvtools.procedural.ray_cast import RoomGeometry, cast, clearance

ATTEMPTS = 40
# Rays along a side of the pictures that a path is judged by.
PROBE = 8
# Ranges that paths are drawn from, and limits, in mean depths of the first view but for angles.
FOV = (50.0, 80.0)  # along the pictures' longer side, degrees
TRAVEL = (0.15, 1.3)  # length of a path
TURN = (5.0, 110.0)  # how far the view turns over a path, degrees
CLEARANCE = 0.06  # least distance to anything
NEAREST = 0.08  # least z-depth of a pixel


def camera_path(
    rng: np.random.Generator,
    geometry: RoomGeometry,
    *,
    views: int,
    size: tuple[int, int],  # (H, W) of the pictures
) -> Cameras:
    """The cameras, in order, of a path through the free space of a scene."""
    K = _intrinsics(rng, size)
    start, forward, depth = _start(rng, geometry, K, size)
    for attempt in range(ATTEMPTS):
        kind = int(rng.choice(len(_KINDS), p=_CHANCES))
        # Later attempts are more modest.
        modesty = 1 - 0.8 * attempt / ATTEMPTS
        travel = modesty * rng.uniform(*TRAVEL) * depth
        turn = modesty * np.radians(rng.uniform(*TURN)) * rng.choice([-1, 1])
        move = _Move(rng, depth, travel, turn)
        poses = _leaning(rng, *_KINDS[kind](move, start, forward, views))
        cameras = _cameras(K, poses, size)
        if _is_free(geometry, cameras, depth):
            return cameras
    move = _Move(rng, depth, 0.0, np.radians(TURN[1] / 2))
    poses = _leaning(rng, *_pan(move, start, forward, views))
    return _cameras(K, poses, size)


@dataclass(frozen=True, eq=False)
class _Move:
    """How far a path goes: mean depth and travel in metres, turn in radians."""

    rng: np.random.Generator
    depth: float
    travel: float
    turn: float


def _intrinsics(rng: np.random.Generator, size: tuple[int, int]) -> Float64:
    height, width = size
    focal = max(size) / (2 * np.tan(np.radians(rng.uniform(*FOV)) / 2))
    offset = rng.normal(0, 0.01, 2) * (rng.random() < 0.5) * max(size)
    x, y = width / 2 + offset[0], height / 2 + offset[1]
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])


def _start(
    rng: np.random.Generator, geometry: RoomGeometry, K: Float64, size: tuple[int, int]
) -> tuple[Float64, Float64, float]:
    """A free place, a direction in which there is something to see, and the mean depth there."""
    volume = np.prod(geometry.rooms[:, 1] - geometry.rooms[:, 0], axis=1)
    rooms = geometry.rooms[rng.choice(len(volume), 24, p=volume / volume.sum())]
    share = rng.uniform(0.12, 0.88, (24, 3))
    share[:, 2] = rng.uniform(0.3, 0.75, 24)
    places = rooms[:, 0] + share * (rooms[:, 1] - rooms[:, 0])
    free = clearance(geometry, places)
    # The freest of a few, so that crowded rooms are seen from somewhere, too.
    best = int(np.argmax(np.where(np.arange(24) < 6, free, free - 0.5 * free.max())))
    best = best if free[best] > 0 else int(np.argmax(free))
    azimuth, dip = rng.uniform(0, 2 * np.pi, 12), rng.normal(-0.12, 0.2, 12)
    forward = np.stack(
        [np.cos(azimuth) * np.cos(dip), np.sin(azimuth) * np.cos(dip), np.sin(dip)], -1
    )
    cameras = _cameras(K, _looking(np.repeat(places[best][None], 12, 0), forward), size)
    seen = cast(geometry, cameras.resized(PROBE, PROBE))
    mean = seen.depth.mean((1, 2))
    # Towards the open, and towards where things stand, more often than not.
    things = np.minimum((seen.solid >= 0).mean((1, 2)), 0.5)
    order = np.argsort(mean / mean.max() + 2 * things)
    pick = order[int(12 * rng.beta(3.0, 1.0))]
    return places[best], forward[pick], float(mean[pick])


def _is_free(geometry: RoomGeometry, cameras: Cameras, depth: float) -> bool:
    if clearance(geometry, cameras.centers).min() < CLEARANCE * depth:
        return False
    seen = cast(geometry, cameras.resized(PROBE, PROBE)).depth
    return bool(seen.min() > NEAREST * depth and np.median(seen, (1, 2)).min() > 0.3 * depth)


_Poses = tuple[Float64, Float64]


def _forward(move: _Move, start: Float64, forward: Float64, views: int) -> _Poses:
    """Ahead, with a drift to the side."""
    along = np.linspace(0, 1, views)[:, None]
    side = np.cross(forward, [0, 0, 1.0]) * move.rng.uniform(-0.5, 0.5)
    place = start + along * move.travel * (forward + side)
    return place, _turned(forward, 0.4 * move.turn * along[:, 0])


def _pull_back(move: _Move, start: Float64, forward: Float64, views: int) -> _Poses:
    """Backwards, so that more and more comes into view."""
    place, direction = _forward(move, start, forward, views)
    return 2 * start - place, direction


def _orbit(move: _Move, start: Float64, forward: Float64, views: int) -> _Poses:
    """Round a point ahead, which stays in the middle."""
    centre = start + forward * move.depth * move.rng.uniform(0.5, 1.0)
    angle = np.linspace(0, 1, views) * move.turn
    arm = _turned(start - centre, angle)
    arm *= np.linspace(1, move.rng.uniform(0.8, 1.2), views)[:, None]
    return centre + arm, -arm


def _pan(move: _Move, start: Float64, forward: Float64, views: int) -> _Poses:
    """Turning on the spot, or nearly so."""
    along = np.linspace(0, 1, views)[:, None]
    step = move.rng.normal(0, 0.3, 3) * [1, 1, 0.3]
    return start + along * 0.3 * move.travel * step, _turned(forward, move.turn * along[:, 0])


def _walk(move: _Move, start: Float64, forward: Float64, views: int) -> _Poses:
    """A wavering way, as somebody takes who films by hand."""
    rng = move.rng
    along = np.linspace(0, 1, views)
    swing = np.sin(2 * np.pi * (along[:, None] * rng.uniform(0.2, 0.9, 3) + rng.random(3)))
    offset = swing * rng.uniform(0.2, 0.6, 3) * [1, 1, 0.5]
    place = start + move.travel * (offset - offset[0])
    yaw = move.turn * along + 0.15 * np.sin(
        2 * np.pi * (along * rng.uniform(0.3, 1) + rng.random())
    )
    direction = _turned(forward, yaw)
    direction[:, 2] += 0.1 * np.sin(2 * np.pi * (along * rng.uniform(0.3, 1) + rng.random()))
    return place, direction


_Path = Callable[[_Move, Float64, Float64, int], _Poses]
_KINDS: tuple[_Path, ...] = (_forward, _pull_back, _orbit, _pan, _walk)
_CHANCES = (0.22, 0.16, 0.26, 0.12, 0.24)


def _turned(vector: Float64, yaw: Float64) -> Float64:
    """(V, 3) a vector turned about the vertical by V angles."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = vector
    return np.stack([c * x - s * y, s * x + c * y, np.full_like(c, z)], -1)


def _leaning(rng: np.random.Generator, place: Float64, forward: Float64) -> Float64:
    """Poses of cameras that are held a little askew."""
    pose = _looking(place, forward)
    angle = np.radians(rng.normal(0, 3) + rng.normal(0, 0.7, len(pose)))
    c, s = np.cos(angle), np.sin(angle)
    roll = np.zeros((len(pose), 4, 4))
    roll[:, 0, 0], roll[:, 0, 1], roll[:, 1, 0], roll[:, 1, 1] = c, s, -s, c
    roll[:, 2, 2] = roll[:, 3, 3] = 1
    return roll @ pose


def _looking(place: Float64, forward: Float64) -> Float64:
    """(V, 4, 4) cam_from_world of level cameras; z is up."""
    z = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    turn = np.stack([x, np.cross(z, x), z], 1)
    return rigid_poses(turn, -np.einsum("vij,vj->vi", turn, place))


def _cameras(K: Float64, poses: Float64, size: tuple[int, int]) -> Cameras:
    names = tuple(f"{i:02d}" for i in range(len(poses)))
    return Cameras.alike(K, poses, size=size[::-1], names=names)
