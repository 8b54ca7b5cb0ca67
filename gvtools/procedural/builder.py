"""Rooms, solids and materials put together one by one, then packed for the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import Float64
from gvtools.procedural.ray_cast import BOX, RoomGeometry
from gvtools.procedural.render import Look
from gvtools.procedural.textures import level_starts, picture, stack_levels, texture

# Order of a room's materials: walls -x, +x, -y, +y, floor, ceiling.
FLOOR, CEILING = 4, 5


class Light(NamedTuple):
    """The last fields of ``render.Look``."""

    ambient: Float64
    sun: Float64
    lamps: Float64
    reach: float
    shadows: bool


@dataclass(frozen=True, eq=False)
class ProceduralScene:
    """A scene to be rendered."""

    kind: str  # which layout it is
    geometry: RoomGeometry  # what rays meet
    look: Look  # materials and light
    key: float  # what the mean of the pictures shall be, linear light


@dataclass(eq=False)
class SceneBuilder:
    """What a scene consists of so far; ``rng`` draws what comes next."""

    rng: np.random.Generator  # of layout and materials
    photographs: Sequence[str]  # names that textures may be cut from
    rooms: list[tuple[Float64, Float64]] = field(default_factory=list)
    room_material: list[list[int]] = field(default_factory=list)
    solids: list[tuple[int, Float64, Float64, Float64, int, bool]] = field(default_factory=list)
    cutters: list[list[tuple[Float64, Float64]]] = field(default_factory=list)
    cutter_material: list[int] = field(default_factory=list)
    textures: list[NDArray[np.uint8]] = field(default_factory=list)
    materials: list[tuple[int, Float64, Float64, Float64, float]] = field(default_factory=list)

    def material(
        self,
        tile: float | tuple[float, float] | None = None,
        *,
        only: str | None = None,  # "picture" for a photograph, where there is one
        gain: ArrayLike = 1.0,  # factor on the texture's linear light
        offset: ArrayLike | None = None,  # of the texture's corner, metres; None draws it
        emission: float = 0.0,
    ) -> int:
        """A material with a texture of its own.

        ``tile``: metres that one copy covers; None draws 0.5 to 4.
        """
        rng = self.rng
        photographic = only == "picture" and len(self.photographs)
        draw = picture if photographic else texture
        image = draw(rng, self.photographs)
        size = np.exp(rng.uniform(np.log(0.5), np.log(4.0))) if tile is None else tile
        place = rng.uniform(0, 4, 2) if offset is None else offset
        return self.coated(image, size, gain=gain, offset=place, emission=emission)

    def coated(
        self,
        image: NDArray[np.uint8],
        tile: ArrayLike,
        *,
        gain: ArrayLike = 1.0,
        offset: ArrayLike = 0.0,
        emission: float = 0.0,
    ) -> int:
        """A material with a given texture: square, as large as the scene's others."""
        self.textures.append(image)
        sides = np.broadcast_to(np.asarray(tile, np.float64), (2,)).copy()
        place = np.broadcast_to(np.asarray(offset, np.float64), (2,)).copy()
        tint = np.broadcast_to(np.asarray(gain, np.float64), (3,)).copy()
        self.materials.append((len(self.textures) - 1, sides, place, tint, emission))
        return len(self.materials) - 1

    def shaded(self, material: int, gain: float) -> int:
        """The same material, brighter or darker."""
        row, sides, place, tint, emission = self.materials[material]
        self.materials.append((row, sides, place, tint * gain, emission))
        return len(self.materials) - 1

    def room(self, low: ArrayLike, high: ArrayLike, materials: Sequence[int]) -> int:
        """Free space between two corners, with a material a wall; returns its number."""
        self.rooms.append((np.asarray(low, np.float64), np.asarray(high, np.float64)))
        self.room_material.append(list(materials))
        return len(self.rooms) - 1

    def solid(
        self,
        kind: int,
        centre: ArrayLike,  # (3,) world frame
        half: ArrayLike,  # (3,) half extents
        *,
        material: int,
        yaw: float = 0.0,  # about the vertical, radians
        tilt: float = 0.0,
        cuts: Sequence[tuple[ArrayLike, ArrayLike]] = (),
        cut_material: int | None = None,
        shades: bool = True,
    ) -> None:
        """A solid, and boxes of its own frame that are cut out of it.

        ``cut_material``: of the surfaces that cutting makes; None for ``material``.
        """
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        c, s = np.cos(tilt), np.sin(tilt)
        lean = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
        corners = np.asarray(centre, float), np.asarray(half, float)
        self.solids.append((kind, lean @ turn, *corners, material, shades))
        boxes = [(np.asarray(a, np.float64), np.asarray(b, np.float64)) for a, b in cuts]
        self.cutters.append(boxes)
        self.cutter_material += [material if cut_material is None else cut_material] * len(boxes)

    def block(self, low: ArrayLike, high: ArrayLike, *, material: int) -> None:
        """A box that stands straight between two corners."""
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        self.solid(BOX, (low + high) / 2, (high - low) / 2, material=material)

    def geometry(self) -> RoomGeometry:
        """Everything put in so far, for rays."""
        count = len(self.solids)
        boxes = [box for boxes in self.cutters for box in boxes]
        kind, rotation, centre, half, material, shades = (
            zip(*self.solids, strict=True) if count else ((),) * 6
        )
        ends = np.cumsum([0, *(len(boxes) for boxes in self.cutters)])
        return RoomGeometry(
            np.array(self.rooms, np.float64),
            np.array(self.room_material, np.int64),
            np.array(kind, np.int64),
            np.array(rotation, np.float64).reshape(count, 3, 3),
            np.array(centre, np.float64).reshape(count, 3),
            np.array(half, np.float64).reshape(count, 3),
            np.array(material, np.int64),
            np.array(shades, np.bool_),
            ends.astype(np.int64),
            np.array(boxes, np.float64).reshape(len(boxes), 2, 3),
            np.array(self.cutter_material, np.int64),
        )

    def look(self, light: Light) -> Look:
        """Materials and a light, for shading."""
        rows, *rest = zip(*self.materials, strict=True)
        tile, offset, gain, emission = (np.array(part, np.float64) for part in rest)
        side = len(self.textures[0])
        texels = stack_levels(self.textures), level_starts(side), side
        row = np.array(rows, np.int64)
        return Look(row, tile, offset, gain, emission, *texels, **light._asdict())
