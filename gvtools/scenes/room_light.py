"""Light baked into a room's surfaces: soft shadows of area lamps and darker corners."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.scenes.ray_casting import Patch

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

CELL = 0.08  # edge of a light-map cell, scene units
AMBIENT_REACH = 1.3  # what is farther than this does not darken a corner, scene units
LIFT = 4e-3  # rays start this far above their surface, scene units


@dataclass(frozen=True, eq=False)
class Block:
    """A solid box turned about the vertical axis.

    Attributes:
        center: (3,) world frame, scene units.
        half: (3,) half its edges.
        yaw: radians.
    """

    center: Float64
    half: Float64
    yaw: float = 0.0

    def interval(self, origin: Float64, ray: Float64) -> tuple[Float64, Float64]:
        """Where (N, 3) rays enter and leave, in multiples of ``ray``; entry > exit: missed."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        start, step = (origin - self.center) @ turn.T, ray @ turn.T
        step = np.where(np.abs(step) < 1e-12, 1e-12, step)
        one, other = (-self.half - start) / step, (self.half - start) / step
        return np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)


@dataclass(frozen=True, eq=False)
class Sphere:
    """A solid ball.

    Attributes:
        center: (3,) world frame, scene units.
        radius: scene units.
    """

    center: Float64
    radius: float

    def interval(self, origin: Float64, ray: Float64) -> tuple[Float64, Float64]:
        """Where (N, 3) rays enter and leave, in multiples of ``ray``; entry > exit: missed."""
        offset = origin - self.center
        return _roots(
            (ray**2).sum(-1), (ray * offset).sum(-1), (offset**2).sum(-1) - self.radius**2
        )


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A solid upright cylinder.

    Attributes:
        foot: (3,) centre of its lower face, world frame, scene units.
        radius: scene units.
        height: scene units.
    """

    foot: Float64
    radius: float
    height: float

    def interval(self, origin: Float64, ray: Float64) -> tuple[Float64, Float64]:
        """Where (N, 3) rays enter and leave, in multiples of ``ray``; entry > exit: missed."""
        offset, across = (origin - self.foot)[:, :2], ray[:, :2]
        enter, leave = _roots(
            (across**2).sum(-1) + 1e-24,
            (across * offset).sum(-1),
            (offset**2).sum(-1) - self.radius**2,
        )
        up = np.where(np.abs(ray[:, 2]) < 1e-12, 1e-12, ray[:, 2])
        one = (self.foot[2] - origin[:, 2]) / up
        other = (self.foot[2] + self.height - origin[:, 2]) / up
        return np.maximum(enter, np.minimum(one, other)), np.minimum(leave, np.maximum(one, other))


Solid = Block | Sphere | Cylinder


def _roots(a: Float64, b: Float64, c: Float64) -> tuple[Float64, Float64]:
    discriminant = b * b - a * c
    root = np.sqrt(np.maximum(discriminant, 0))
    missed = discriminant < 0
    return np.where(missed, np.inf, (-b - root) / a), np.where(missed, -np.inf, (-b + root) / a)


def first_hit(solids: Sequence[Solid], origin: Float64, ray: Float64) -> Float64:
    """(N,) where (N, 3) rays meet the first solid, in multiples of ``ray``; infinity: nowhere."""
    nearest = np.full(len(origin), np.inf)
    for solid in solids:
        enter, leave = solid.interval(origin, ray)
        met = (enter < leave) & (leave > 0)
        np.minimum(nearest, np.maximum(enter, 0), out=nearest, where=met)
    return nearest


@dataclass(frozen=True, eq=False)
class Lamp:
    """A parallelogram ``origin + s u + t v`` that shines towards v x u.

    Attributes:
        origin: (3,) world frame, scene units.
        u: (3,) one edge.
        v: (3,) the other.
        power: (3,) linear red, green and blue.
    """

    origin: Float64
    u: Float64
    v: Float64
    power: Float64

    def samples(self, along: int, across: int) -> Iterator[Float64]:
        """Centres of along x across equal parts, each (3,)."""
        for i in range(along):
            for j in range(across):
                yield self.origin + (i + 0.5) / along * self.u + (j + 0.5) / across * self.v


def bake(
    patches: Sequence[Patch],
    *,
    solids: Sequence[Solid],
    lamps: Sequence[Lamp],
    ambient: Float64,
    room: Float64,
) -> list[Float32]:
    """The light on each patch.

    Args:
        patches: P surfaces.
        solids: what casts shadows.
        lamps: where light comes from.
        ambient: (3,) light that an open place gets from everywhere.
        room: (3,) the room's size; its corner lies at the world's origin.

    Returns:
        P arrays (rows along t, columns along s, 3) float32, linear light.
    """
    shapes, places, normals = [], [], []
    for patch in patches:
        length, breadth = patch.size
        shape = tuple(int(np.clip(round(x / CELL), 4, 96)) for x in (breadth, length))
        t, s = ((np.arange(n) + 0.5) / n for n in shape)
        position, normal = patch.at(*(grid.ravel() for grid in np.meshgrid(s, t)))
        shapes.append(shape)
        places.append(position + LIFT * normal)
        normals.append(normal)
    place, normal = np.concatenate(places), np.concatenate(normals)
    light = ambient * _openness(place, normal, solids, room)[:, None]
    for lamp in lamps:
        light += _direct(place, normal, solids, lamp)
    split = np.cumsum([rows * columns for rows, columns in shapes])[:-1]
    return [
        part.reshape(*shape, 3).astype(np.float32)
        for part, shape in zip(np.split(light, split), shapes, strict=True)
    ]


def _openness(
    place: Float64, normal: Float64, solids: Sequence[Solid], room: Float64, *, rays: int = 28
) -> Float64:
    """(N,) in [0, 1]: how far cosine-distributed rays get before they meet something."""
    side = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(side, normal)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    bitangent = np.cross(normal, tangent)
    total = np.zeros(len(place))
    for i in range(rays):
        # Fibonacci points on the disk, lifted to the hemisphere: cosine-distributed, the same for
        # every cell, so neighbours differ by geometry and not by chance.
        r, angle = np.sqrt((i + 0.5) / rays), i * np.pi * (3 - np.sqrt(5))
        up = np.sqrt(1 - r * r)
        ray = r * np.cos(angle) * tangent + r * np.sin(angle) * bitangent + up * normal
        _, wall = Block(room / 2, room / 2).interval(place, ray)
        reach = np.minimum(first_hit(solids, place, ray), np.maximum(wall, 0))
        total += np.sqrt(np.minimum(reach / AMBIENT_REACH, 1))
    return total / rays


def _direct(place: Float64, normal: Float64, solids: Sequence[Solid], lamp: Lamp) -> Float64:
    axis = np.cross(lamp.v, lamp.u)
    axis = axis / np.linalg.norm(axis)
    parts = list(lamp.samples(6, 4))
    light = np.zeros(len(place))
    for part in parts:
        ray = part - place
        distance = np.linalg.norm(ray, axis=-1)
        strength = np.maximum((ray * normal).sum(-1), 0) * np.maximum(-(ray @ axis), 0)
        rows = np.flatnonzero(strength > 0)
        blocked = first_hit(solids, place[rows], ray[rows]) < 0.995
        light[rows] += np.where(blocked, 0, strength[rows] / distance[rows] ** 4)
    return light[:, None] / len(parts) * lamp.power
