"""Light baked into a room's surfaces: soft shadows of area lamps and darker corners."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.scenes.ray_casting import Patch

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

CELL = 0.09  # edge of a light-map cell, scene units
AMBIENT_REACH = 1.3  # what is farther than this does not darken a corner, scene units
BURIED = 0.25  # light on a patch that is buried but for less than a cell
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

    def ball(self) -> tuple[Float64, float]:
        """Centre and radius of a ball round it."""
        return self.center, float(np.linalg.norm(self.half))

    def interval(self, origin: Float64, ray: Float64) -> tuple[Float64, Float64]:
        """Where (N, 3) rays enter and leave, in multiples of ``ray``; entry > exit: missed."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        starts, steps = ((origin - self.center) @ turn.T).T, (ray @ turn.T).T
        enter, leave = np.full(len(origin), -np.inf), np.full(len(origin), np.inf)
        for start, step, half in zip(starts, steps, self.half, strict=True):
            across = np.where(np.abs(step) < 1e-12, 1e-12, step)
            one, other = (-half - start) / across, (half - start) / across
            np.maximum(enter, np.minimum(one, other), out=enter)
            np.minimum(leave, np.maximum(one, other), out=leave)
        return enter, leave


@dataclass(frozen=True, eq=False)
class Sphere:
    """A solid ball.

    Attributes:
        center: (3,) world frame, scene units.
        radius: scene units.
    """

    center: Float64
    radius: float

    def ball(self) -> tuple[Float64, float]:
        """Centre and radius of a ball round it."""
        return self.center, self.radius

    def interval(self, origin: Float64, ray: Float64) -> tuple[Float64, Float64]:
        """Where (N, 3) rays enter and leave, in multiples of ``ray``; entry > exit: missed."""
        offset = origin - self.center
        return _roots(_dot(ray, ray), _dot(ray, offset), _dot(offset, offset) - self.radius**2)


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

    def ball(self) -> tuple[Float64, float]:
        """Centre and radius of a ball round it."""
        half = self.height / 2
        return self.foot + np.array([0, 0, half]), float(np.hypot(self.radius, half))

    def interval(self, origin: Float64, ray: Float64) -> tuple[Float64, Float64]:
        """Where (N, 3) rays enter and leave, in multiples of ``ray``; entry > exit: missed."""
        offset, across = (origin - self.foot)[:, :2], ray[:, :2]
        enter, leave = _roots(
            _dot(across, across) + 1e-24,
            _dot(across, offset),
            _dot(offset, offset) - self.radius**2,
        )
        up = np.where(np.abs(ray[:, 2]) < 1e-12, 1e-12, ray[:, 2])
        one = (self.foot[2] - origin[:, 2]) / up
        other = (self.foot[2] + self.height - origin[:, 2]) / up
        return np.maximum(enter, np.minimum(one, other)), np.minimum(leave, np.maximum(one, other))


Solid = Block | Sphere | Cylinder


def _dot(a: Float64, b: Float64) -> Float64:
    """(N,) scalar products of (N, d) or (d,) vectors."""
    return np.einsum("...i,...i->...", a, b)


def _roots(a: Float64, b: Float64, c: Float64) -> tuple[Float64, Float64]:
    discriminant = b * b - a * c
    root = np.sqrt(np.maximum(discriminant, 0))
    missed = discriminant < 0
    return np.where(missed, np.inf, (-b - root) / a), np.where(missed, -np.inf, (-b + root) / a)


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
        fewest = 6 if min(length, breadth) > 0.1 else 3
        shape = tuple(int(np.clip(round(x / CELL), fewest, 96)) for x in (breadth, length))
        t, s = ((np.arange(n) + 0.5) / n for n in shape)
        position, normal = patch.at(*(grid.ravel() for grid in np.meshgrid(s, t)))
        shapes.append(shape)
        places.append(position + LIFT * normal)
        normals.append(normal)
    place, normal = np.concatenate(places), np.concatenate(normals)
    light = ambient * _openness(place, normal, solids, room)[:, None]
    for lamp in lamps:
        light += _direct(place, normal, solids, lamp)
    light[_buried(place, solids)] = np.nan
    split = np.cumsum([rows * columns for rows, columns in shapes])[:-1]
    return [
        _filled(part.reshape(*shape, 3)).astype(np.float32)
        for part, shape in zip(np.split(light, split), shapes, strict=True)
    ]


def _buried(place: Float64, solids: Sequence[Solid]) -> NDArray[np.bool_]:
    """(N,) places inside a solid."""
    inside = np.zeros(len(place), bool)
    up = np.array([0.0, 0.0, 1.0])
    for solid in solids:
        center, radius = solid.ball()
        rows = np.flatnonzero(_dot(place - center, place - center) < radius**2)
        enter, leave = solid.interval(place[rows], np.broadcast_to(up, (len(rows), 3)))
        inside[rows] |= (enter < 0) & (leave > 0)
    return inside


def _filled(light: Float64) -> Float64:
    """Buried cells take their nearest neighbour's light, or they would darken the cells around."""
    from scipy.ndimage import distance_transform_edt

    buried = np.isnan(light[..., 0])
    if not buried.any():
        return light
    if buried.all():
        return np.full_like(light, BURIED)
    rows, columns = distance_transform_edt(buried, return_distances=False, return_indices=True)
    return light[rows, columns]


def _openness(
    place: Float64, normal: Float64, solids: Sequence[Solid], room: Float64, *, rays: int = 24
) -> Float64:
    """(N,) in [0, 1]: how far cosine-distributed rays get before they meet something."""
    side = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(side, normal)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    bitangent = np.cross(normal, tangent)
    near = [(solid, _near(place, solid, AMBIENT_REACH)) for solid in solids]
    walls = Block(room / 2, room / 2)
    total = np.zeros(len(place))
    for i in range(rays):
        # Fibonacci points on the disk, lifted to the hemisphere: cosine-distributed, the same for
        # every cell, so neighbours differ by geometry and not by chance.
        r, angle = np.sqrt((i + 0.5) / rays), i * np.pi * (3 - np.sqrt(5))
        up = np.sqrt(1 - r * r)
        ray = r * np.cos(angle) * tangent + r * np.sin(angle) * bitangent + up * normal
        reach = np.clip(walls.interval(place, ray)[1], 0, AMBIENT_REACH)
        for solid, rows in near:
            enter, leave = solid.interval(place[rows], ray[rows])
            met = np.where((enter < leave) & (leave > 0), np.maximum(enter, 0), np.inf)
            reach[rows] = np.minimum(reach[rows], met)
        total += np.sqrt(reach / AMBIENT_REACH)
    return total / rays


def _near(place: Float64, solid: Solid, reach: float) -> NDArray[np.intp]:
    center, radius = solid.ball()
    return np.flatnonzero(_dot(place - center, place - center) < (radius + reach) ** 2)


def _direct(place: Float64, normal: Float64, solids: Sequence[Solid], lamp: Lamp) -> Float64:
    axis = np.cross(lamp.v, lamp.u)
    axis = axis / np.linalg.norm(axis)
    parts = np.array(list(lamp.samples(5, 4)))
    ray = parts - place[:, None]
    squared = np.einsum("npi,npi->np", ray, ray)
    facing = np.einsum("npi,ni->np", ray, normal)
    strength = np.maximum(facing, 0) * np.maximum(-(ray @ axis), 0)
    strength /= squared**2
    middle = lamp.origin + (lamp.u + lamp.v) / 2
    extent = float(np.linalg.norm(lamp.u) + np.linalg.norm(lamp.v)) / 2
    lit = strength.any(axis=1)
    for solid in solids:
        rows = np.flatnonzero(lit & _between(place, middle, solid, extent))
        for j in range(len(parts)):
            enter, leave = solid.interval(place[rows], ray[rows, j])
            strength[rows[(enter < leave) & (leave > 0) & (enter < 0.995)], j] = 0
    return strength.mean(1)[:, None] * lamp.power


def _between(place: Float64, end: Float64, solid: Solid, extent: float) -> NDArray[np.bool_]:
    """(N,) whether a solid may stand between places and a lamp of that extent round ``end``."""
    center, radius = solid.ball()
    ray = end - place
    length = np.sqrt(_dot(ray, ray))
    along = np.clip(_dot(center - place, ray) / length**2, 0, 1)
    offset = place + along[:, None] * ray - center
    return _dot(offset, offset) < (radius + extent * np.minimum(along + radius / length, 1)) ** 2
