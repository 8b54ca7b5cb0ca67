"""A furnished room drawn from a seed: surfaces to see, solids that cast shadows, lamps.

The world's z axis points up, the floor is z = 0, one corner of the room is the origin, and the
unit is the metre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.procedural.materials import PICTURES, Texture, globe, paint, picture, planks, tiled
from gvtools.scenes.ray_casting import Patch
from gvtools.scenes.room_builder import Builder, Place, Triple
from gvtools.scenes.room_light import Lamp, Solid

Float64 = NDArray[np.float64]

WALLS: tuple[Triple, ...] = ((0.86, 0.82, 0.74), (0.74, 0.81, 0.84), (0.80, 0.84, 0.74))
ACCENTS: tuple[Triple, ...] = ((0.66, 0.38, 0.29), (0.72, 0.66, 0.58), (0.45, 0.52, 0.60))
WOODS: tuple[Triple, ...] = ((0.63, 0.45, 0.30), (0.50, 0.36, 0.25), (0.72, 0.58, 0.42))
RUGS: tuple[Triple, ...] = ((0.55, 0.24, 0.22), (0.25, 0.36, 0.50), (0.36, 0.46, 0.30))
COATS: tuple[Triple, ...] = (
    (0.80, 0.33, 0.25),
    (0.24, 0.48, 0.56),
    (0.88, 0.71, 0.32),
    (0.38, 0.54, 0.36),
    (0.85, 0.83, 0.80),
    (0.30, 0.28, 0.36),
)


@dataclass(frozen=True, eq=False)
class Room:
    """A room.

    Attributes:
        size: (3,) metres.
        patches: all surfaces.
        solids: what casts shadows; the walls and small things are not among them.
        lamps: area lights.
    """

    size: Float64
    patches: tuple[Patch, ...]
    solids: tuple[Solid, ...]
    lamps: tuple[Lamp, ...]


def furnished_room(seed: int) -> Room:
    """The room of a seed: another seed gives other sizes, materials, furniture and pictures."""
    rng = np.random.default_rng([seed, 20])
    build = Builder(rng)
    size = np.array([rng.uniform(5.6, 6.8), rng.uniform(4.8, 5.6), rng.uniform(2.5, 2.9)])
    _shell(build, size)
    _walls(build, size)
    _corners(build, size)
    _middle(build, size)
    return Room(size, tuple(build.patches), tuple(build.solids), tuple(build.lamps))


def _shell(build: Builder, size: Float64) -> None:
    rng = build.rng
    x, y, z = np.diag(size)
    zero = np.zeros(3)
    floor = (
        lambda: planks(build.pick(WOODS), rng),
        lambda: tiled("gravel", build.pick(((0.62, 0.60, 0.57), (0.55, 0.50, 0.44)))),
        lambda: tiled("brick", build.pick(((0.62, 0.52, 0.44), (0.58, 0.58, 0.56)))),
    )[rng.choice(3, p=(0.6, 0.2, 0.2))]()
    build.flat(y, x, -y, texture=floor)
    build.flat(z, x, y, texture=paint((0.92, 0.91, 0.88), grain=0.015))
    plain = paint(build.pick(WALLS), grain=0.03)
    accent = (
        lambda: tiled("brick", build.pick(ACCENTS), turned=True),
        lambda: tiled("gravel", build.pick(ACCENTS), contrast=0.6),
    )[rng.integers(2)]()
    special = rng.integers(4)
    for i, (corner, along) in enumerate(((x, -x), (x + y, -y), (y, x), (zero, y))):
        texture = accent if i == special else plain
        build.flat(corner + z, along, -z, texture=texture)
    lamp = np.array([1.3, 0.9, 0]) * rng.uniform(0.8, 1.1)
    corner = np.array([*(size[:2] - lamp[:2]) / 2, size[2] - 0.012])
    u, v = np.diag(lamp)[:2]
    build.flat(corner, u, v, texture=paint((1, 1, 0.97), grain=0.004), emission=1.6)
    build.lamps.append(Lamp(corner, u, v, np.array([1.0, 0.95, 0.86]) * 3.0))


def _walls(build: Builder, size: Float64) -> None:
    """Each wall gets slots; a slot gets one piece of furniture and what hangs above it."""
    rng = build.rng
    names = list(rng.permutation(PICTURES))
    pieces = [_shelf, _cabinet, _crates, _bench, _cabinet, _nothing, _bench, _shelf, _crates]
    pieces = [pieces[i] for i in rng.permutation(len(pieces))]
    window_wall = int(rng.integers(4))
    along = (size[0], size[1], size[0], size[1])
    corners = ((0.0, 0.0), (size[0], 0.0), (size[0], size[1]), (0.0, size[1]))
    for wall in range(4):
        at = Place(np.array([*corners[wall], 0.0]), wall * np.pi / 2)
        count = 2 if along[wall] < 5.3 else 3
        room_for = (along[wall] - 1.7) / count
        for slot in range(count):
            start = 0.85 + slot * room_for + rng.uniform(0.05, 0.15)
            width = room_for - rng.uniform(0.25, 0.45)
            if wall == window_wall and slot == count // 2:
                _window(build, at, start, width)
                continue
            piece = pieces.pop() if pieces else _nothing
            top = piece(build, at, start, width)
            if top < 1.2 and names:
                _hang(build, at, start + width / 2, names.pop())


def _hang(build: Builder, at: Place, middle: float, name: str) -> None:
    """A framed photograph."""
    rng = build.rng
    texture = picture(str(name))
    height = rng.uniform(0.65, 0.9)
    width = min(height * texture.aspect, 1.25)
    height = width / texture.aspect
    low, left = 1.62 - height / 2 + rng.uniform(-0.05, 0.12), middle - width / 2
    rim, depth = 0.045, 0.035
    wood = paint(build.pick(((0.16, 0.13, 0.11), (0.80, 0.76, 0.68), (0.45, 0.31, 0.20))))
    bars = (
        ((left - rim, 0, low - rim), (left + width + rim, depth, low)),
        ((left - rim, 0, low + height), (left + width + rim, depth, low + height + rim)),
        ((left - rim, 0, low), (left, depth, low + height)),
        ((left + width, 0, low), (left + width + rim, depth, low + height)),
    )
    for one, other in bars:
        build.box(at, one, other, texture=wood)
    _face(build, at, (left, 0.012, low), width, height, texture=texture)


def _face(
    build: Builder,
    at: Place,
    corner: Triple,
    width: float,
    height: float,
    *,
    texture: Texture,
    emission: float = 0.0,
) -> None:
    """A picture on a wall, seen upright from inside the room; corner: lower left along the wall."""
    u = at.axes()[0]
    origin = at.world(corner[0] + width, corner[1], corner[2] + height)
    build.flat(
        origin, -u * width, np.array([0, 0, -height]), texture=texture, once=True, emission=emission
    )


def _window(build: Builder, at: Place, start: float, width: float) -> None:
    """A window onto the launch pad at dusk, with slim bars, and the daylight that it lets in."""
    width, low, height = min(width, 1.7), 0.85, 1.2
    _face(build, at, (start, 0.004, low), width, height, texture=picture("rocket"), emission=0.8)
    bar = paint((0.93, 0.92, 0.90), grain=0.01)
    thick, deep = 0.035, 0.06
    for x in (0.0, width / 2 - thick / 2, width - thick):
        build.box(at, (start + x, 0, low), (start + x + thick, deep, low + height), texture=bar)
    for z in (0.0, height * 0.62, height - thick):
        build.box(at, (start, 0, low + z), (start + width, deep, low + z + thick), texture=bar)
    build.box(at, (start - 0.1, 0, low - 0.05), (start + width + 0.1, 0.16, low), texture=bar)
    u = at.axes()[0]
    origin = at.world(start + width, 0.09, low + height)
    power = np.array([0.75, 0.88, 1.1]) * 1.5
    build.lamps.append(Lamp(origin, -u * width, np.array([0, 0, -height]), power))


def _nothing(build: Builder, at: Place, start: float, width: float) -> float:
    return 0.0


def _shelf(build: Builder, at: Place, start: float, width: float) -> float:
    """A bookcase with rows of books."""
    rng = build.rng
    width, deep, height, board = min(width, 1.15), 0.3, rng.uniform(1.75, 1.95), 0.03
    wood = planks(build.pick(WOODS), rng)
    build.box(at, (start, 0, 0), (start + width, 0.02, height), texture=wood)
    for x in (start, start + width - board):
        build.box(at, (x, 0.02, 0), (x + board, deep, height), texture=wood)
    levels = np.linspace(0.06, height - board, 5)
    for z in levels:
        build.box(
            at, (start + board, 0.02, z), (start + width - board, deep, z + board), texture=wood
        )
    coats = [tiled("text", color, contrast=0.6, turned=True) for color in COATS]
    for z in levels[:-1]:
        x = start + board + rng.uniform(0.0, 0.1)
        while x < start + width - board - 0.13:
            thick, tall, back = (
                rng.uniform(0.05, 0.12),
                rng.uniform(0.22, 0.33),
                rng.uniform(0.03, 0.1),
            )
            build.box(
                at,
                (x, 0.03, z + board),
                (x + thick, deep - back, z + board + tall),
                texture=coats[rng.integers(len(coats))],
                shadow=False,
            )
            x += thick + (rng.uniform(0.1, 0.3) if rng.random() < 0.2 else 0.004)
    return height


def _cabinet(build: Builder, at: Place, start: float, width: float) -> float:
    """A painted chest with a round thing on it."""
    rng = build.rng
    deep, height = rng.uniform(0.4, 0.5), rng.uniform(0.7, 0.85)
    coat = paint(build.pick(COATS), grain=0.035)
    build.box(at, (start, 0.02, 0.08), (start + width, deep, height), texture=coat)
    top = planks(build.pick(WOODS), rng)
    build.box(
        at,
        (start - 0.02, 0, height),
        (start + width + 0.02, deep + 0.03, height + 0.03),
        texture=top,
    )
    for i in range(2):
        x = start + width * (0.27 + 0.46 * i)
        build.box(
            at,
            (x - 0.06, deep, height * 0.62),
            (x + 0.06, deep + 0.025, height * 0.62 + 0.02),
            texture=paint((0.2, 0.19, 0.18)),
        )
    radius = rng.uniform(0.09, 0.14)
    center = at.world(start + width * rng.uniform(0.2, 0.8), deep / 2, height + 0.03 + radius)
    build.ball(center, radius, texture=globe(("moon", "retina", "coffee")[rng.integers(3)]))
    return height + 0.03 + 2 * radius


def _crates(build: Builder, at: Place, start: float, width: float) -> float:
    """Two or three boxes, one on another."""
    rng = build.rng
    sides = rng.uniform(0.38, 0.52, 3)
    texture = tiled("text", build.pick(((0.72, 0.58, 0.40), (0.66, 0.52, 0.36))), contrast=0.5)
    other = planks(build.pick(WOODS), rng, rows=4)
    middle = start + width / 2
    top = 0.0
    for i, side in enumerate(sides):
        x = (middle - 0.28, middle + 0.3, middle - 0.25)[i]
        z = sides[0] if i == 2 else 0.0
        spot = Place(at.world(x, 0.36, z), at.yaw + rng.uniform(-0.25, 0.25))
        half = side / 2
        build.box(spot, (-half, -half, 0), (half, half, side), texture=other if i == 1 else texture)
        top = max(top, z + side)
        if i == 1 and rng.random() < 0.4:
            break
    return top


def _bench(build: Builder, at: Place, start: float, width: float) -> float:
    """A padded bench on four thin legs."""
    deep, seat = 0.5, 0.42
    cloth = tiled("grass", build.pick(RUGS), contrast=0.45)
    build.box(at, (start, 0.04, seat - 0.12), (start + width, deep, seat), texture=cloth)
    build.box(at, (start, 0.03, seat), (start + width, 0.13, seat + 0.38), texture=cloth)
    leg = paint((0.22, 0.18, 0.15))
    for x in (start + 0.04, start + width - 0.08):
        for y in (0.06, deep - 0.08):
            build.box(at, (x, y, 0), (x + 0.04, y + 0.04, seat - 0.12), texture=leg)
    return seat + 0.38


def _corners(build: Builder, size: Float64) -> None:
    """A column in one corner, a floor lamp in another."""
    rng = build.rng
    inset = 0.42
    spots = [
        np.array([x, y, 0.0]) for x in (inset, size[0] - inset) for y in (inset, size[1] - inset)
    ]
    first, second = rng.permutation(4)[:2]
    stone = (
        tiled("brick", build.pick(ACCENTS), turned=True)
        if rng.random() < 0.5
        else tiled("gravel", (0.70, 0.67, 0.62))
    )
    build.post(spots[first], rng.uniform(0.17, 0.22), float(size[2]), texture=stone)
    metal = paint((0.25, 0.24, 0.24), grain=0.02)
    foot = spots[second]
    build.post(foot, 0.14, 0.025, texture=metal)
    build.post(foot + np.array([0, 0, 0.025]), 0.014, 1.45, texture=metal)
    build.post(
        foot + np.array([0, 0, 1.4]),
        0.18,
        0.26,
        texture=paint(build.pick(((0.93, 0.85, 0.66),)), grain=0.02),
    )


def _middle(build: Builder, size: Float64) -> None:
    """A rug, a table with things on it, two chairs."""
    rng = build.rng
    at = Place(np.array([size[0] / 2, size[1] / 2, 0.0]), rng.uniform(-0.5, 0.5))
    rug = tiled("grass", build.pick(RUGS), contrast=0.8)
    build.box(at, (-1.15, -0.85, 0), (1.15, 0.85, 0.012), texture=rug)
    half = np.array([rng.uniform(0.55, 0.72), rng.uniform(0.36, 0.44)])
    top, board = 0.74, 0.035
    wood = planks(build.pick(WOODS), rng)
    build.box(at, (-half[0], -half[1], top - board), (half[0], half[1], top), texture=wood)
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * (half[0] - 0.06), sy * (half[1] - 0.06)
            build.box(
                at, (x - 0.025, y - 0.025, 0), (x + 0.025, y + 0.025, top - board), texture=wood
            )
    build.ball(
        at.world(-half[0] * 0.5, half[1] * 0.2, top + 0.15),
        0.15,
        texture=globe(("moon", "retina", "astronaut")[rng.integers(3)]),
    )
    build.post(
        at.world(half[0] * 0.1, -half[1] * 0.5, top), 0.045, 0.1, texture=paint(build.pick(COATS))
    )
    spot = Place(at.world(half[0] * 0.6, half[1] * 0.25, top), at.yaw + rng.uniform(-0.6, 0.6))
    z = 0.0
    for _ in range(3):
        x, y, thick = rng.uniform(0.1, 0.15), rng.uniform(0.07, 0.1), rng.uniform(0.025, 0.05)
        cover = tiled("text", build.pick(COATS), contrast=0.5)
        build.box(spot, (-x, -y, z), (x, y, z + thick), texture=cover)
        z += thick
    for side in (-1, 1):
        turn = at.yaw + (np.pi if side > 0 else 0.0) + rng.uniform(-0.35, 0.35)
        _chair(build, Place(at.world(rng.uniform(-0.2, 0.2), side * (half[1] + 0.3), 0), turn))


def _chair(build: Builder, at: Place) -> None:
    """A chair that faces its second axis."""
    coat = paint(build.pick(COATS), grain=0.04)
    build.box(at, (-0.21, -0.2, 0.42), (0.21, 0.2, 0.46), texture=coat)
    for x in (-0.2, 0.17):
        for y in (-0.19, 0.16):
            tall = 0.86 if y < 0 else 0.42
            build.box(at, (x, y, 0), (x + 0.03, y + 0.03, tall), texture=coat)
    for z in (0.6, 0.76):
        build.box(at, (-0.17, -0.185, z), (0.17, -0.165, z + 0.08), texture=coat)
