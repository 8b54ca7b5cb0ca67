"""Boxes, posts, balls and sheets put into a room: what is seen of them, and what casts shadows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gvtools.scenes.ray_casting import Ball, Flat, Patch, Tube
from gvtools.scenes.room_light import Block, Cylinder, Lamp, Solid, Sphere
from gvtools.scenes.room_textures import Texture

Float64 = NDArray[np.float64]
Triple = tuple[float, float, float]

TILE = 1.1  # edge of a repeated texture, metres


@dataclass(eq=False)
class Place:
    """A place in the room: its origin, and the angle of its first axis."""

    origin: Float64
    yaw: float = 0.0

    def axes(self) -> Float64:
        """(3, 3), its axes in the world as rows."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def world(self, x: float, y: float, z: float) -> Float64:
        """(3,) world position of a place's coordinates, metres."""
        return self.origin + np.array([x, y, z]) @ self.axes()


@dataclass(eq=False)
class Builder:
    """What has been put into a room so far; ``rng`` draws what comes next."""

    rng: np.random.Generator
    patches: list[Patch] = field(default_factory=list)
    solids: list[Solid] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)

    def pick(self, choices: tuple[Triple, ...]) -> Triple:
        """One of the colours, slightly varied."""
        color = np.array(choices[self.rng.integers(len(choices))])
        return tuple(np.clip(color * self.rng.uniform(0.92, 1.06, 3), 0, 1).tolist())

    def flat(
        self,
        origin: Float64,
        u: Float64,
        v: Float64,
        *,
        texture: Texture,
        once: bool = False,
        round: bool = False,
        emission: float = 0.0,
    ) -> None:
        """A thin sheet ``origin + s u + t v``; its texture tiles unless it is shown ``once``."""
        length, breadth = float(np.linalg.norm(u)), float(np.linalg.norm(v))
        tiles = (1.0, 1.0) if once else (length / TILE, breadth / TILE)
        self.patches.append(Flat(texture, tiles, emission, origin, u, v, round))

    def box(
        self, at: Place, low: Triple, high: Triple, *, texture: Texture, shadow: bool = True
    ) -> None:
        """A box between two corners in a place's axes."""
        low_, high_ = np.array(low), np.array(high)
        x, y, z = np.diag(high_ - low_) @ at.axes()
        a = at.world(*low_)
        b = at.world(*high_)
        for origin, u, v in (
            (a + z, x, -z),
            (b, -x, -z),
            (b - x, -y, -z),
            (a + x + z, y, -z),
            (a + z + y, x, -y),
            (a, x, y),
        ):
            # Lower faces stay undrawn on the floor, where no camera can see them.
            if u is x and v is y and a[2] < 0.02:
                continue
            flipped = np.cross(v, u) @ (origin + (u + v) / 2 - (a + b) / 2) < 0
            if flipped:
                origin, u = origin + u, -u
            self.flat(origin, u, v, texture=texture)
        if shadow:
            self.solids.append(Block((a + b) / 2, (high_ - low_) / 2, at.yaw))

    def post(self, foot: Float64, radius: float, height: float, *, texture: Texture) -> None:
        """A cylinder with its lid."""
        around = max(1.0, round(2 * np.pi * radius / TILE))
        self.patches.append(Tube(texture, (around, height / TILE), 0.0, foot, radius, height))
        corner = foot + np.array([-radius, radius, height])
        u, v = np.array([2 * radius, 0, 0]), np.array([0, -2 * radius, 0])
        self.flat(corner, u, v, texture=texture, round=True)
        self.solids.append(Cylinder(foot, radius, height))

    def ball(self, center: Float64, radius: float, *, texture: Texture) -> None:
        """A sphere under one of :func:`globe`'s textures."""
        self.patches.append(Ball(texture, (1.0, 0.5), 0.0, center, radius))
        self.solids.append(Sphere(center, radius))
