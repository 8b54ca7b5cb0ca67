"""Things that stand about in procedural rooms: boxes, balls, posts, shelves, tables, arches."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gvtools.procedural.builder import SceneBuilder
from gvtools.procedural.geometry import BALL, BOX, TUBE

Float64 = NDArray[np.float64]


def add_clutter(
    build: SceneBuilder, low: Float64, high: Float64, count: int, *, scale: float, palette: int
) -> None:
    """Put things on the floor of a room.

    Args:
        build: gets them.
        low: (3,) lowest corner of the room.
        high: (3,) highest corner.
        count: how many.
        scale: typical size of a thing, metres.
        palette: how many different materials they share.
    """
    rng = build.rng
    materials = [build.material(scale * np.exp(rng.uniform(-0.7, 0.9))) for _ in range(palette)]
    taken: list[tuple[float, float, float]] = []
    for _ in range(count):
        size = scale * np.exp(rng.uniform(-0.9, 0.7))
        size = min(size, 0.28 * float(min(high[:2] - low[:2])), 0.9 * float(high[2] - low[2]))
        place = _free_place(rng, low, high, size, taken)
        if place is None:
            continue
        taken.append((*place, size))
        thing = _THINGS[rng.choice(len(_THINGS), p=_CHANCES)]
        own = materials[rng.integers(palette)]
        other = materials[rng.integers(palette)]
        thing(build, np.array([*place, low[2]]), size, own, other, high[2] - low[2])


def _free_place(
    rng: np.random.Generator,
    low: Float64,
    high: Float64,
    size: float,
    taken: list[tuple[float, float, float]],
) -> tuple[float, float] | None:
    """A place on the floor that is not within another thing; None after a few attempts."""
    for _ in range(6):
        x, y = rng.uniform(low[:2] + 0.4 * size, high[:2] - 0.4 * size)
        if all((x - a) ** 2 + (y - b) ** 2 > (0.6 * (size + c)) ** 2 for a, b, c in taken):
            return float(x), float(y)
    return None


def _above(foot: Float64, height: float, x: float = 0.0, y: float = 0.0) -> Float64:
    """(3,) a place over a thing's foot, or beside that."""
    return foot + np.array([x, y, height])


def _box(
    build: SceneBuilder, foot: Float64, size: float, own: int, other: int, room: float
) -> None:
    """A yawed box, now and then with a smaller one on it."""
    rng = build.rng
    half = 0.5 * size * np.exp(rng.uniform(-0.5, 0.4, 3))
    half[2] = min(half[2], 0.45 * room)
    yaw = rng.uniform(0, np.pi)
    build.solid(BOX, _above(foot, half[2]), half, material=own, yaw=yaw)
    if rng.random() < 0.4 and 3 * half[2] < room:
        top = 0.5 * half * rng.uniform(0.5, 1, 3)
        where = _above(foot, 2 * half[2] + top[2], *rng.uniform(-0.3, 0.3, 2) * half[:2])
        build.solid(BOX, where, top, material=other, yaw=rng.uniform(0, np.pi))


def _leaning(
    build: SceneBuilder, foot: Float64, size: float, own: int, other: int, room: float
) -> None:
    """A box turned about two axes, standing in the floor or hanging in the air."""
    rng = build.rng
    half = 0.45 * size * np.exp(rng.uniform(-0.6, 0.3, 3))
    lift = rng.uniform(0.5, 1.4) * size if rng.random() < 0.6 else 0.6 * room
    build.solid(
        BOX, _above(foot, min(lift, 0.8 * room)), half,
        material=own, yaw=rng.uniform(0, np.pi), tilt=rng.uniform(-1, 1),
    )  # fmt: skip


def _ball(
    build: SceneBuilder, foot: Float64, size: float, own: int, other: int, room: float
) -> None:
    """A ball or an ellipsoid, lying, hanging or standing on a post."""
    rng = build.rng
    half = 0.4 * size * (np.exp(rng.uniform(-0.3, 0.3, 3)) if rng.random() < 0.4 else np.ones(3))
    lift = half[2]
    if rng.random() < 0.4 and room > 4 * half[2]:
        lift = rng.uniform(2 * half[2], room - 1.5 * half[2])
        if rng.random() < 0.6:
            post = [0.2 * half[0], 0.2 * half[1], lift / 2]
            build.solid(TUBE, _above(foot, lift / 2), post, material=other)
    build.solid(BALL, _above(foot, lift), half, material=own, yaw=rng.uniform(0, np.pi))


def _bowl(
    build: SceneBuilder, foot: Float64, size: float, own: int, other: int, room: float
) -> None:
    """A ball with a box cut out of it: half of it, a quarter, or a slot through it."""
    rng = build.rng
    radius = 0.45 * size
    low, high = np.full(3, -2 * radius), np.full(3, 2 * radius)
    for axis in rng.permutation(3)[: rng.integers(1, 3)]:
        cut = rng.uniform(-0.4, 0.5) * radius
        low[axis] = cut
        if rng.random() < 0.3:
            high[axis] = cut + rng.uniform(0.3, 0.7) * radius
    build.solid(
        BALL, _above(foot, radius), [radius] * 3, material=own, yaw=rng.uniform(0, np.pi),
        cuts=[(low, high)], cut_material=other,
    )  # fmt: skip


def _post(
    build: SceneBuilder, foot: Float64, size: float, own: int, other: int, room: float
) -> None:
    """A pillar up to the ceiling, or a drum."""
    rng = build.rng
    radius = size * rng.uniform(0.12, 0.3)
    height = room if rng.random() < 0.4 else min(size * rng.uniform(0.4, 1.6), room)
    kind = TUBE if rng.random() < 0.7 else BOX
    half = [radius, radius * rng.uniform(0.7, 1.3), height / 2]
    build.solid(kind, _above(foot, height / 2), half, material=own, yaw=rng.uniform(0, np.pi))


def _shelf(
    build: SceneBuilder, foot: Float64, size: float, own: int, other: int, room: float
) -> None:
    """A case with compartments that are open in front, some with a thing in them."""
    rng = build.rng
    width, depth = size * rng.uniform(0.7, 1.3), size * rng.uniform(0.25, 0.45)
    height = min(size * rng.uniform(0.8, 1.8), 0.95 * room)
    board = 0.04 * size
    rows, columns = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    cell = np.array([(width - board) / columns, (height - board) / rows])
    yaw = rng.choice([0, 1, 2, 3]) * np.pi / 2 if rng.random() < 0.5 else rng.uniform(0, 2 * np.pi)
    cuts = []
    for i in range(columns):
        for j in range(rows):
            x = -width / 2 + board + i * cell[0]
            z = -height / 2 + board + j * cell[1]
            low = np.array([x, -depth, z])
            high = np.array([x + cell[0] - board, depth / 2 - board, z + cell[1] - board])
            cuts.append((low, high))
            if rng.random() < 0.4:
                half = 0.5 * (cell[[0, 1]].min() - board) * rng.uniform(0.3, 0.8, 3)
                half[1] = min(half[1], 0.4 * depth)
                local = np.array([(low[0] + high[0]) / 2, 0, z + half[2]])
                c, s = np.cos(yaw), np.sin(yaw)
                where = _above(foot, local[2] + height / 2, c * local[0], s * local[0])
                build.solid(BOX, where, half, material=other, yaw=yaw)
    build.solid(
        BOX, _above(foot, height / 2), [width / 2, depth / 2, height / 2],
        material=own, yaw=yaw, cuts=cuts,
    )  # fmt: skip


def _table(
    build: SceneBuilder, foot: Float64, size: float, own: int, other: int, room: float
) -> None:
    """A slab on four legs: a box with two tunnels that cross; smaller things stand on it."""
    rng = build.rng
    half = size * np.array([rng.uniform(0.5, 0.8), rng.uniform(0.35, 0.6), rng.uniform(0.25, 0.45)])
    half[2] = min(half[2], 0.4 * room)
    leg, top = 0.08 * size, 0.08 * size
    inner = half - [leg, leg, top]
    yaw = rng.uniform(0, np.pi)
    cuts = [
        ([-inner[0], -2 * half[1], -2 * half[2]], [inner[0], 2 * half[1], inner[2]]),
        ([-2 * half[0], -inner[1], -2 * half[2]], [2 * half[0], inner[1], inner[2]]),
    ]
    build.solid(BOX, _above(foot, half[2]), half, material=own, yaw=yaw, cuts=cuts)
    c, s = np.cos(yaw), np.sin(yaw)
    for _ in range(rng.integers(0, 4)):
        x, y = rng.uniform(-0.7, 0.7, 2) * half[:2]
        small = size * rng.uniform(0.06, 0.18, 3)
        where = _above(foot, 2 * half[2] + small[2], c * x - s * y, s * x + c * y)
        kind = (BOX, BALL, TUBE)[rng.integers(3)]
        build.solid(kind, where, small, material=other, yaw=rng.uniform(0, np.pi))


def _arch(
    build: SceneBuilder, foot: Float64, size: float, own: int, other: int, room: float
) -> None:
    """A thick wall with an opening through it, to the ground or as a window."""
    rng = build.rng
    half = 0.5 * size * np.array([rng.uniform(0.9, 1.6), rng.uniform(0.15, 0.4), 1.5])
    half[2] = min(half[2] * rng.uniform(0.6, 1.2), 0.48 * room)
    width = half[0] * rng.uniform(0.4, 0.75)
    bottom = -2 * half[2] if rng.random() < 0.6 else -half[2] * rng.uniform(0, 0.4)
    cut = ([-width, -2 * half[1], bottom], [width, 2 * half[1], half[2] * rng.uniform(0.3, 0.8)])
    build.solid(
        BOX, _above(foot, half[2]), half, material=own, yaw=rng.uniform(0, np.pi),
        cuts=[cut], cut_material=other,
    )  # fmt: skip


_Thing = Callable[[SceneBuilder, Float64, float, int, int, float], None]
_THINGS: tuple[_Thing, ...] = (_box, _leaning, _ball, _bowl, _post, _shelf, _table, _arch)
_CHANCES = (0.29, 0.1, 0.14, 0.07, 0.1, 0.1, 0.12, 0.08)
