"""Procedural scenes by seed: rooms, corridors, corners, suites, halls and close-ups, lit at random.

Train and held-out scenes differ in photographs and seeds, and in the ranges that layouts are drawn
from: held-out rooms are somewhat larger and higher, with fewer and larger things in them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.procedural.builder import Light, ProceduralScene, SceneBuilder
from gvtools.procedural.clutter import add_clutter
from gvtools.procedural.geometry import Geometry, clearance
from gvtools.procedural.openings import add_frames, add_openings, add_side_room
from gvtools.procedural.photographs import photograph_names

Float64 = NDArray[np.float64]
Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class LayoutStyle:
    """Ranges that scenes are drawn from; lengths in metres.

    Attributes:
        kinds: chances of room, corridor, corner, suite, hall and close-up.
        side: of a room.
        height: of a room.
        things: on the floor of a room of 15 square metres.
        size: of a thing.
        openings: most recesses in the walls.
        key: mean of the pictures, linear light.
    """

    kinds: tuple[float, ...]
    side: Range
    height: Range
    things: Range
    size: Range
    openings: int
    key: Range


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
    """A scene.

    Args:
        rng: decides everything.
        split: "train" or "held-out".
    """
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


def _light(rng: np.random.Generator, geometry: Geometry) -> Light:
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
