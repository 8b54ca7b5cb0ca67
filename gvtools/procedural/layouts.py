"""Procedural scenes by seed: rooms, corridors, corners, suites, halls and close-ups, lit at random.

Train and held-out scenes differ in photographs and seeds, and in the ranges that layouts are drawn
from: held-out rooms are somewhat larger and higher, with fewer and larger things in them. Niches,
windows and doors are rooms of their own that overlap the one they open from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gvtools.cameras import Float64
from gvtools.procedural.builder import CEILING, Light, ProceduralScene, SceneBuilder
from gvtools.procedural.ray_cast import BALL, BOX, TUBE, RoomGeometry, clearance
from gvtools.procedural.textures import photograph_names


def add_clutter(
    build: SceneBuilder, low: Float64, high: Float64, count: int, *, scale: float, palette: int
) -> None:
    """Put things on the floor of a room between two corners, (3,) each.

    They are about ``scale`` metres large, and share a palette of so many materials.
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
        foot = np.array([*place, low[2]])
        thing(_Spot(build, rng, size, high[2] - low[2], own, other, foot))


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


class _Spot(NamedTuple):
    """Where a thing stands, and what it is made of."""

    build: SceneBuilder
    rng: np.random.Generator
    size: float  # metres
    room: float  # up to the ceiling, metres
    own: int  # its materials
    other: int
    foot: Float64  # (3,)

    def above(self, height: float, x: float = 0.0, y: float = 0.0) -> Float64:
        """(3,) a place over the foot, or beside that."""
        return self.foot + np.array([x, y, height])


def _box(at: _Spot) -> None:
    """A yawed box, now and then with a smaller one on it."""
    build, rng, size, room, own, other = at[:6]
    half = 0.5 * size * np.exp(rng.uniform(-0.5, 0.4, 3))
    half[2] = min(half[2], 0.45 * room)
    yaw = rng.uniform(0, np.pi)
    build.solid(BOX, at.above(half[2]), half, material=own, yaw=yaw)
    if rng.random() < 0.4 and 3 * half[2] < room:
        top = 0.5 * half * rng.uniform(0.5, 1, 3)
        where = at.above(2 * half[2] + top[2], *rng.uniform(-0.3, 0.3, 2) * half[:2])
        build.solid(BOX, where, top, material=other, yaw=rng.uniform(0, np.pi))


def _leaning(at: _Spot) -> None:
    """A box turned about two axes, standing in the floor or hanging in the air."""
    build, rng, size, room, own, *_ = at
    half = 0.45 * size * np.exp(rng.uniform(-0.6, 0.3, 3))
    lift = rng.uniform(0.5, 1.4) * size if rng.random() < 0.6 else 0.6 * room
    build.solid(
        BOX, at.above(min(lift, 0.8 * room)), half,
        material=own, yaw=rng.uniform(0, np.pi), tilt=rng.uniform(-1, 1),
    )  # fmt: skip


def _ball(at: _Spot) -> None:
    """A ball or an ellipsoid, lying, hanging or standing on a post."""
    build, rng, size, room, own, other = at[:6]
    half = 0.4 * size * (np.exp(rng.uniform(-0.3, 0.3, 3)) if rng.random() < 0.4 else np.ones(3))
    lift = half[2]
    if rng.random() < 0.4 and room > 4 * half[2]:
        lift = rng.uniform(2 * half[2], room - 1.5 * half[2])
        if rng.random() < 0.6:
            post = [0.2 * half[0], 0.2 * half[1], lift / 2]
            build.solid(TUBE, at.above(lift / 2), post, material=other)
    build.solid(BALL, at.above(lift), half, material=own, yaw=rng.uniform(0, np.pi))


def _bowl(at: _Spot) -> None:
    """A ball with a box cut out of it: half of it, a quarter, or a slot through it."""
    build, rng, size, _, own, other = at[:6]
    radius = 0.45 * size
    low, high = np.full(3, -2 * radius), np.full(3, 2 * radius)
    for axis in rng.permutation(3)[: rng.integers(1, 3)]:
        cut = rng.uniform(-0.4, 0.5) * radius
        low[axis] = cut
        if rng.random() < 0.3:
            high[axis] = cut + rng.uniform(0.3, 0.7) * radius
    build.solid(
        BALL, at.above(radius), [radius] * 3, material=own, yaw=rng.uniform(0, np.pi),
        cuts=[(low, high)], cut_material=other,
    )  # fmt: skip


def _post(at: _Spot) -> None:
    """A pillar up to the ceiling, or a drum."""
    build, rng, size, room, own, *_ = at
    radius = size * rng.uniform(0.12, 0.3)
    height = room if rng.random() < 0.4 else min(size * rng.uniform(0.4, 1.6), room)
    kind = TUBE if rng.random() < 0.7 else BOX
    half = [radius, radius * rng.uniform(0.7, 1.3), height / 2]
    build.solid(kind, at.above(height / 2), half, material=own, yaw=rng.uniform(0, np.pi))


def _shelf(at: _Spot) -> None:
    """A case with compartments that are open in front, some with a thing in them."""
    build, rng, size, room, own, other = at[:6]
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
                where = at.above(local[2] + height / 2, c * local[0], s * local[0])
                build.solid(BOX, where, half, material=other, yaw=yaw)
    build.solid(
        BOX, at.above(height / 2), [width / 2, depth / 2, height / 2],
        material=own, yaw=yaw, cuts=cuts,
    )  # fmt: skip


def _table(at: _Spot) -> None:
    """A slab on four legs: a box with two tunnels that cross; smaller things stand on it."""
    build, rng, size, room, own, other = at[:6]
    half = size * np.array([rng.uniform(0.5, 0.8), rng.uniform(0.35, 0.6), rng.uniform(0.25, 0.45)])
    half[2] = min(half[2], 0.4 * room)
    leg, top = 0.08 * size, 0.08 * size
    inner = half - [leg, leg, top]
    yaw = rng.uniform(0, np.pi)
    cuts = [
        ([-inner[0], -2 * half[1], -2 * half[2]], [inner[0], 2 * half[1], inner[2]]),
        ([-2 * half[0], -inner[1], -2 * half[2]], [2 * half[0], inner[1], inner[2]]),
    ]
    build.solid(BOX, at.above(half[2]), half, material=own, yaw=yaw, cuts=cuts)
    c, s = np.cos(yaw), np.sin(yaw)
    for _ in range(rng.integers(0, 4)):
        x, y = rng.uniform(-0.7, 0.7, 2) * half[:2]
        small = size * rng.uniform(0.06, 0.18, 3)
        where = at.above(2 * half[2] + small[2], c * x - s * y, s * x + c * y)
        kind = (BOX, BALL, TUBE)[rng.integers(3)]
        build.solid(kind, where, small, material=other, yaw=rng.uniform(0, np.pi))


def _arch(at: _Spot) -> None:
    """A thick wall with an opening through it, to the ground or as a window."""
    build, rng, size, room, own, other = at[:6]
    half = 0.5 * size * np.array([rng.uniform(0.9, 1.6), rng.uniform(0.15, 0.4), 1.5])
    half[2] = min(half[2] * rng.uniform(0.6, 1.2), 0.48 * room)
    width = half[0] * rng.uniform(0.4, 0.75)
    bottom = -2 * half[2] if rng.random() < 0.6 else -half[2] * rng.uniform(0, 0.4)
    cut = ([-width, -2 * half[1], bottom], [width, 2 * half[1], half[2] * rng.uniform(0.3, 0.8)])
    build.solid(
        BOX, at.above(half[2]), half, material=own, yaw=rng.uniform(0, np.pi),
        cuts=[cut], cut_material=other,
    )  # fmt: skip


_THINGS: tuple[Callable[[_Spot], None], ...] = (
    _box,
    _leaning,
    _ball,
    _bowl,
    _post,
    _shelf,
    _table,
    _arch,
)
_CHANCES = (0.29, 0.1, 0.14, 0.07, 0.1, 0.1, 0.12, 0.08)


OVERLAP = 0.02  # by which an opening reaches into its room, metres


def add_openings(
    build: SceneBuilder,
    low: Float64,  # (3,) lowest corner of the room
    high: Float64,  # (3,) highest corner
    skin: Sequence[int],
    count: int,
    *,
    walls: Sequence[int] = (0, 1, 2, 3),
    scale: float = 1.0,  # of the openings; 1 for a living room
) -> None:
    """Niches and windows in the walls of a room, at most one a wall."""
    rng = build.rng
    for wall in rng.permutation(walls)[:count]:
        length = high[1 - wall // 2] - low[1 - wall // 2]
        width = min(scale * rng.uniform(0.6, 2.2), 0.7 * length)
        top = low[2] + (high[2] - low[2]) * rng.uniform(0.6, 0.95)
        bottom = low[2] + rng.choice([0.0, 0.25, 0.4]) * (top - low[2])
        start = rng.uniform(0.1, 0.9) * (length - width)
        window = rng.random() < 0.45
        depth = scale * (rng.uniform(0.1, 0.3) if window else rng.uniform(0.2, 0.9))
        materials = [*skin]
        if window:
            materials[wall] = build.material(
                (width, top - bottom), only="picture", gain=rng.uniform(0.7, 1.3),
                emission=rng.uniform(0.6, 1.8),
            )  # fmt: skip
        elif rng.random() < 0.5:
            materials = [build.material()] * 6
        a, b = _beyond(low, high, int(wall), start, start + width, depth)
        a[2], b[2] = bottom, top
        build.room(a, b, materials)


def add_side_room(
    build: SceneBuilder, low: Float64, high: Float64, skin: Sequence[int], wall: int, size: Float64
) -> tuple[Float64, Float64]:
    """A room of a size (3,) behind a wall, and the door that leads to it; returns its corners."""
    rng = build.rng
    across = 1 - wall // 2
    length = high[across] - low[across]
    width = min(rng.uniform(0.8, 1.6), 0.6 * length)
    top = low[2] + min(rng.uniform(1.9, 2.3), 0.95 * (high[2] - low[2]))
    start = rng.uniform(0.1, 0.9) * (length - width)
    thick = rng.uniform(0.08, 0.3)
    door_low, door_high = _beyond(low, high, wall, start, start + width, thick + OVERLAP)
    door_low[2], door_high[2] = low[2], top
    jamb = build.material()
    build.room(door_low, door_high, [jamb, jamb, jamb, jamb, skin[4], jamb])
    # The side room begins where the wall ends, and its floor goes on from the door's.
    middle = start + width / 2
    reach = max(float(size[across]), 1.5 * width)
    offset = middle - reach * rng.uniform(0.35, 0.65)
    side_low, side_high = _beyond(low, high, wall, offset, offset + reach, thick + size[wall // 2])
    if wall % 2:
        side_low[wall // 2] = high[wall // 2] + thick
    else:
        side_high[wall // 2] = low[wall // 2] - thick
    side_low[2], side_high[2] = low[2], low[2] + max(float(size[2]), 1.02 * (top - low[2]))
    paint = build.material()
    floor = skin[4] if rng.random() < 0.5 else build.material()
    build.room(side_low, side_high, [paint] * 4 + [floor, skin[CEILING]])
    return side_low, side_high


def add_frames(
    build: SceneBuilder,
    low: Float64,  # (3,) lowest corner of the room
    high: Float64,  # (3,) highest corner
    count: int,
    *,
    walls: Sequence[int] = (0, 1, 2, 3),
    scale: float = 1.0,  # of the pictures; 1 for a living room
) -> None:
    """Pictures on the walls: thin boxes with a photograph each."""
    rng = build.rng
    for _ in range(count):
        wall = int(walls[int(rng.integers(len(walls)))])
        across = 1 - wall // 2
        length, tall = high[across] - low[across], high[2] - low[2]
        width = min(scale * rng.uniform(0.4, 1.4), 0.6 * length)
        height = min(width * rng.uniform(0.6, 1.3), 0.6 * tall)
        start = low[across] + rng.uniform(0.1, 0.9) * (length - width)
        bottom = low[2] + rng.uniform(0.25, 0.9) * (tall - height)
        thick = 0.03 * scale
        corner = np.zeros(3)
        half = np.zeros(3)
        face = high[wall // 2] - thick / 2 if wall % 2 else low[wall // 2] + thick / 2
        corner[wall // 2], half[wall // 2] = face, thick / 2
        corner[across], half[across] = start + width / 2, width / 2
        corner[2], half[2] = bottom + height / 2, height / 2
        material = build.material(
            (width, height), only="picture", offset=(-width / 2, -height / 2),
            gain=rng.uniform(0.8, 1.3),
        )  # fmt: skip
        build.block(corner - half, corner + half, material=material)


def _beyond(
    low: Float64, high: Float64, wall: int, start: float, end: float, depth: float
) -> tuple[Float64, Float64]:
    """Corners of a space behind a wall, ``start`` to ``end`` along it, as high as the room."""
    axis = wall // 2
    a, b = low.copy(), high.copy()
    a[1 - axis], b[1 - axis] = low[1 - axis] + start, low[1 - axis] + end
    if wall % 2:
        a[axis], b[axis] = high[axis] - OVERLAP, high[axis] + depth
    else:
        a[axis], b[axis] = low[axis] - depth, low[axis] + OVERLAP
    return a, b


Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class LayoutStyle:
    """Ranges that scenes are drawn from; lengths in metres."""

    kinds: tuple[float, ...]  # chances of room, corridor, corner, suite, hall and close-up
    side: Range  # of a room
    height: Range  # of a room
    things: Range  # on the floor of a room of 15 square metres
    size: Range  # of a thing
    openings: int  # most recesses in the walls
    key: Range  # mean of the pictures, linear light


STYLES = {
    "train": LayoutStyle(
        kinds=(0.3, 0.12, 0.14, 0.16, 0.1, 0.18),
        side=(2.8, 6.5),
        height=(2.2, 3.1),
        things=(3, 9),
        size=(0.45, 1.0),
        openings=3,
        key=(0.12, 0.3),
    ),
    "held-out": LayoutStyle(
        kinds=(0.26, 0.14, 0.16, 0.18, 0.1, 0.16),
        side=(3.2, 7.4),
        height=(2.4, 3.5),
        things=(3, 7),
        size=(0.55, 1.15),
        openings=4,
        key=(0.13, 0.28),
    ),
}


def scene(rng: np.random.Generator, split: str) -> ProceduralScene:
    """A scene of a split, "train" or "held-out"."""
    build = SceneBuilder(rng, photograph_names(split))
    style = STYLES[split]
    kind = rng.choice(len(_LAYOUTS), p=style.kinds)
    _LAYOUTS[kind](build, style)
    geometry = build.geometry()
    light = _light(rng, geometry)
    return ProceduralScene(
        _LAYOUTS[kind].__name__[1:], geometry, build.look(light), rng.uniform(*style.key)
    )


def _skin(build: SceneBuilder) -> list[int]:
    """Materials of a room's six sides: a wallpaper, now and then another wall, floor, ceiling."""
    rng = build.rng
    wall = build.material()
    walls = [build.shaded(wall, rng.uniform(0.85, 1.15)) for _ in range(4)]
    if rng.random() < 0.5:
        walls[rng.integers(4)] = build.material()
    return [*walls, build.material(), build.material(gain=rng.uniform(0.9, 1.3))]


def _size(build: SceneBuilder, style: LayoutStyle, factor: float = 1.0) -> Float64:
    rng = build.rng
    return factor * np.array([*rng.uniform(*style.side, 2), rng.uniform(*style.height)])


def _furnish(build: SceneBuilder, style: LayoutStyle, low: Float64, high: Float64) -> None:
    rng = build.rng
    area = float(np.prod(high[:2] - low[:2]))
    scale = rng.uniform(*style.size)
    count = round(rng.uniform(*style.things) * np.clip(area / 15, 0.4, 1.8))
    add_clutter(build, low, high, count, scale=scale, palette=int(rng.integers(3, 6)))


def _room(build: SceneBuilder, style: LayoutStyle) -> None:
    high = _size(build, style)
    skin = _skin(build)
    low = np.zeros(3)
    build.room(low, high, skin)
    add_openings(build, low, high, skin, int(build.rng.integers(0, style.openings + 1)))
    add_frames(build, low, high, int(build.rng.integers(0, 4)))
    _furnish(build, style, low, high)


def _corridor(build: SceneBuilder, style: LayoutStyle) -> None:
    rng = build.rng
    high = np.array([rng.uniform(2, 3.4) * style.side[1] / 2, rng.uniform(1.3, 2.3), 0])
    high[2] = rng.uniform(*style.height)
    skin = _skin(build)
    low = np.zeros(3)
    build.room(low, high, skin)
    for wall in rng.permutation([2, 3, 1])[: rng.integers(1, 4)]:
        add_side_room(build, low, high, skin, int(wall), _size(build, style, 0.7))
    add_openings(build, low, high, skin, int(rng.integers(0, style.openings + 1)))
    add_frames(build, low, high, int(rng.integers(0, 4)))
    add_clutter(build, low, high, int(rng.integers(1, 5)), scale=0.5, palette=3)


def _corner(build: SceneBuilder, style: LayoutStyle) -> None:
    """Two rooms at right angles, without a wall between them."""
    rng = build.rng
    first, second = _size(build, style, 1.1), _size(build, style, 1.1)
    wide, deep = rng.uniform(0.4, 0.65, 2)
    skin = _skin(build)
    low = np.zeros(3)
    end = np.array([first[0], deep * first[1], first[2]])
    wing = np.array([wide * first[0], deep * first[1] + 0.7 * second[1], first[2]])
    build.room(low, end, skin)
    build.room(low, wing, skin)
    add_openings(build, low, end, skin, int(rng.integers(0, style.openings + 1)), walls=(1, 2))
    add_frames(build, low, wing, int(rng.integers(0, 3)), walls=(0, 3))
    _furnish(build, style, low, end)
    _furnish(build, style, np.array([0, end[1], 0]), wing)


def _suite(build: SceneBuilder, style: LayoutStyle) -> None:
    """A room with doors or passages to others."""
    rng = build.rng
    high = _size(build, style, 0.9)
    skin = _skin(build)
    low = np.zeros(3)
    build.room(low, high, skin)
    for wall in rng.permutation(4)[: rng.integers(1, 3)]:
        side = add_side_room(build, low, high, skin, int(wall), _size(build, style, 0.8))
        _furnish(build, style, *side)
    add_frames(build, low, high, int(rng.integers(0, 3)))
    _furnish(build, style, low, high)


def _hall(build: SceneBuilder, style: LayoutStyle) -> None:
    """A large space, now and then open to the sky."""
    rng = build.rng
    factor = rng.uniform(1.8, 3.2)
    high = _size(build, style, factor) * [1, 1, rng.uniform(0.6, 1)]
    skin = _skin(build)
    if rng.random() < 0.4:
        skin[5] = build.material(30, gain=rng.uniform(0.8, 1.6), emission=rng.uniform(0.5, 1.2))
    low = np.zeros(3)
    build.room(low, high, skin)
    add_openings(build, low, high, skin, int(rng.integers(0, style.openings + 1)), scale=factor / 2)
    scale = factor * rng.uniform(*style.size)
    add_clutter(build, low, high, int(rng.integers(4, 12)), scale=scale, palette=4)


def _close_up(build: SceneBuilder, style: LayoutStyle) -> None:
    """A small space full of small things."""
    rng = build.rng
    high = _size(build, style, rng.uniform(0.35, 0.6))
    skin = _skin(build)
    low = np.zeros(3)
    build.room(low, high, skin)
    add_frames(build, low, high, int(rng.integers(0, 3)), scale=0.4)
    scale = float(min(high)) * rng.uniform(0.15, 0.32)
    add_clutter(build, low, high, int(rng.integers(5, 13)), scale=scale, palette=5)


_LAYOUTS: tuple[Callable[[SceneBuilder, LayoutStyle], None], ...] = (
    _room,
    _corridor,
    _corner,
    _suite,
    _hall,
    _close_up,
)


def _light(rng: np.random.Generator, geometry: RoomGeometry) -> Light:
    """Light from above and below, a direction, and a lamp in the first room."""
    warmth = np.array([rng.uniform(0.9, 1.15), 1.0, rng.uniform(0.8, 1.1)])
    ambient = np.stack([rng.uniform(0.35, 0.9) * warmth, rng.uniform(0.15, 0.5) * np.ones(3)])
    azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 1.2)
    towards = [np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)]
    sun = np.stack([towards, rng.uniform(0, 0.6) * np.array([1.0, 0.97, 0.9])])
    low, high = geometry.rooms[0]
    place = (low + high) / 2
    for _ in range(8):
        place = low + (high - low) * [*rng.uniform(0.15, 0.85, 2), rng.uniform(0.6, 0.95)]
        if clearance(geometry, place[None])[0] > 0.02 * float(min(high - low)):
            break
    strength = rng.uniform(0.2, 1.4) * (rng.random() < 0.8)
    lamp = np.stack([place, strength * np.array([1.05, 0.98, rng.uniform(0.75, 1.0)])])
    reach = rng.uniform(0.3, 0.8) * float(np.linalg.norm(high - low))
    return Light(ambient, sun, lamp[None], reach, bool(strength > 0 and rng.random() < 0.6))
