"""What interrupts a wall: niches, windows with something bright behind, doors, pictures.

An opening is a room of its own that overlaps the one it opens from.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.procedural.builder import CEILING, SceneBuilder

Float64 = NDArray[np.float64]

OVERLAP = 0.02  # by which an opening reaches into its room, metres


def add_openings(
    build: SceneBuilder,
    low: Float64,
    high: Float64,
    skin: Sequence[int],
    count: int,
    *,
    walls: Sequence[int] = (0, 1, 2, 3),
    scale: float = 1.0,
) -> None:
    """Niches and windows in the walls of a room, at most one a wall.

    Args:
        build: gets them.
        low: (3,) lowest corner of the room.
        high: (3,) highest corner.
        skin: the room's six materials.
        count: how many.
        walls: which may be opened, numbered as materials are.
        scale: of the openings; 1 for a living room.
    """
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
    build: SceneBuilder,
    low: Float64,
    high: Float64,
    skin: Sequence[int],
    wall: int,
    size: Float64,
) -> tuple[Float64, Float64]:
    """A room behind a wall and the door that leads to it; returns the side room's corners.

    Args:
        build: gets them.
        low: (3,) lowest corner of the room.
        high: (3,) highest corner.
        skin: the room's six materials.
        wall: which wall, numbered as materials are.
        size: (3,) of the side room.
    """
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
    low: Float64,
    high: Float64,
    count: int,
    *,
    walls: Sequence[int] = (0, 1, 2, 3),
    scale: float = 1.0,
) -> None:
    """Pictures on the walls: thin boxes with a photograph each.

    Args:
        build: gets them.
        low: (3,) lowest corner of the room.
        high: (3,) highest corner.
        count: how many.
        walls: which may have one, numbered as materials are.
        scale: of the pictures; 1 for a living room.
    """
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
