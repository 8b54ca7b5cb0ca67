"""Rooms, solids and materials put together one by one, then packed for the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.procedural.geometry import Geometry, Solid
from gvtools.procedural.shading import Light, Look
from gvtools.procedural.textures import picture, stacked, texture

Float64 = NDArray[np.float64]

# Order of a room's materials: walls -x, +x, -y, +y, floor, ceiling.
FLOOR, CEILING = 4, 5


class Space(NamedTuple):
    """An axis-aligned box of a scene, metres.

    Attributes:
        low: (3,) lowest corner.
        high: (3,) highest corner.
        skin: materials of its walls -x, +x, -y, +y, of its floor and of its ceiling.
    """

    low: Float64
    high: Float64
    skin: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class ProceduralScene:
    """A scene to be rendered.

    Attributes:
        geometry: what rays meet.
        look: materials and light.
        key: what the mean of the pictures shall be, linear light.
    """

    geometry: Geometry
    look: Look
    key: float


@dataclass(eq=False)
class SceneBuilder:
    """What a scene consists of so far; ``rng`` draws what comes next.

    Attributes:
        rng: of layout and materials.
        photographs: names that textures may be cut from.
    """

    rng: np.random.Generator
    photographs: Sequence[str]
    rooms: list[Space] = field(default_factory=list)
    solids: list[Solid] = field(default_factory=list)
    textures: list[NDArray[np.uint8]] = field(default_factory=list)
    materials: list[tuple[int, Float64, Float64, Float64, float]] = field(default_factory=list)

    def material(
        self,
        tile: float | tuple[float, float] | None = None,
        *,
        only: str | None = None,
        gain: ArrayLike = 1.0,
        offset: ArrayLike | None = None,
        emission: float = 0.0,
    ) -> int:
        """A material with a texture of its own.

        Args:
            tile: metres that one copy covers; None draws 0.5 to 4.
            only: "picture" for a photograph, where there is one.
            gain: factor on the texture's linear light.
            offset: of the texture's corner, metres; None draws it.
            emission: light of its own.
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

    def room(self, low: ArrayLike, high: ArrayLike, skin: Sequence[int]) -> Space:
        """Free space between two corners, with a material a wall."""
        space = Space(np.asarray(low, np.float64), np.asarray(high, np.float64), tuple(skin))
        self.rooms.append(space)
        return space

    def solid(
        self,
        kind: int,
        centre: ArrayLike,
        half: ArrayLike,
        *,
        material: int,
        yaw: float = 0.0,
        tilt: float = 0.0,
        cuts: Sequence[tuple[ArrayLike, ArrayLike]] = (),
        cut_material: int | None = None,
        shades: bool = True,
    ) -> None:
        """A solid, and boxes of its own frame that are cut out of it.

        Args:
            kind: BOX, BALL or TUBE.
            centre: (3,) world frame.
            half: (3,) half extents.
            material: of its surface.
            yaw: about the vertical, radians.
            tilt: about its own first axis, before the yaw.
            cuts: lowest and highest corners.
            cut_material: of the surfaces that cutting makes; None for ``material``.
            shades: whether it keeps a lamp's light away.
        """
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        c, s = np.cos(tilt), np.sin(tilt)
        lean = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
        boxes = np.array([*cuts], np.float64).reshape(-1, 2, 3)
        inner = material if cut_material is None else cut_material
        middle, extent = np.asarray(centre, np.float64), np.asarray(half, np.float64)
        self.solids.append(Solid(kind, lean @ turn, middle, extent, material, shades, boxes, inner))

    def geometry(self) -> Geometry:
        """Everything put in so far, for rays."""
        rooms = np.array([(room.low, room.high) for room in self.rooms])
        skins = np.array([room.skin for room in self.rooms], np.int64)
        return Geometry(rooms, skins, tuple(self.solids))

    def look(self, light: Light) -> Look:
        """Materials and a light, for shading."""
        rows, tile, offset, gain, emission = zip(*self.materials, strict=True)
        return Look(
            np.array(rows, np.int64),
            np.array(tile, np.float64),
            np.array(offset, np.float64),
            np.array(gain, np.float64),
            np.array(emission, np.float64),
            stacked(self.textures),
            light,
        )
