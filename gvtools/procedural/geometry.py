"""Procedural geometry: rooms to stand in, solids in them, pieces cut out.

Free space is the union of axis-aligned boxes ("rooms") less the solids; a solid is a turned box,
ellipsoid or elliptic cylinder less boxes in its own frame ("cuts").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

BOX, BALL, TUBE = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Solid:
    """A body in a room.

    Attributes:
        kind: BOX, BALL or TUBE (along its z axis).
        rotation: (3, 3) local_from_world.
        centre: (3,) world frame.
        half: (3,) half extents along the local axes.
        material: of its surface.
        shades: whether it keeps a lamp's light away.
        cuts: (M, 2, 3) lowest and highest corner of the boxes that are cut out, own frame.
        cut_material: of the surfaces that cutting makes.
    """

    kind: int
    rotation: Float64
    centre: Float64
    half: Float64
    material: int
    shades: bool
    cuts: Float64
    cut_material: int

    def local(self, points: Float64) -> Float64:
        """(..., 3) world points in the solid's frame."""
        return (points - self.centre) @ self.rotation.T


@dataclass(frozen=True, eq=False)
class Geometry:
    """What rays meet. World frame: z up, metres.

    Attributes:
        rooms: (R, 2, 3) lowest and highest corner of each room.
        room_material: (R, 6) of the walls -x, +x, -y, +y, of the floor and of the ceiling.
        solids: N of them.
    """

    rooms: Float64
    room_material: Int64
    solids: tuple[Solid, ...]


def clearance(geometry: Geometry, points: Float64) -> Float64:
    """(P,) distance of points to the nearest wall or solid's hull, negative inside or outside.

    In a room of several boxes, the distance to the walls is that of the best box: never too large.
    """
    low, high = geometry.rooms[:, 0, None], geometry.rooms[:, 1, None]
    free = np.minimum(points - low, high - points).min(-1).max(0)
    for solid in geometry.solids:
        over = np.abs(solid.local(points)) - solid.half
        outer = np.linalg.norm(np.maximum(over, 0), axis=-1)
        free = np.minimum(free, np.where(outer > 0, outer, over.max(-1)))
    return free
