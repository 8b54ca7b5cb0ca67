"""Procedural geometry: rooms to stand in, solids in them, pieces cut out.

Free space is the union of axis-aligned boxes ("rooms") less the solids; a solid is a turned box,
ellipsoid or elliptic cylinder less boxes in its own frame ("cutters"). A ray's way through it is a
matter of intervals, so every intersection is exact, doorways, niches and shelves included.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

BOX, BALL, TUBE = 0, 1, 2
# Codes of the surface that a ray meets beside 0, 1, 2: flat, across that local axis.
ROUND, SIDE = 3, 4


class Geometry(NamedTuple):
    """What rays meet. World frame: z up, metres.

    Attributes:
        rooms: (R, 2, 3) lowest and highest corner of each room.
        room_material: (R, 6) of the walls -x, +x, -y, +y, of the floor and of the ceiling.
        kind: (N,) BOX, BALL or TUBE (along its z axis).
        rotation: (N, 3, 3) local_from_world.
        centre: (N, 3).
        half: (N, 3) half extents along the local axes.
        material: (N,).
        shades: (N,) bool, whether it keeps a lamp's light away.
        first_cutter: (N + 1,) where each solid's cutters start.
        cutter: (M, 2, 3) lowest and highest corner, frame of their solid.
        cutter_material: (M,) of the surfaces that cutting makes.
    """

    rooms: Float64
    room_material: Int64
    kind: Int64
    rotation: Float64
    centre: Float64
    half: Float64
    material: Int64
    shades: NDArray[np.bool_]
    first_cutter: Int64
    cutter: Float64
    cutter_material: Int64


@compiled()
def clearance(geometry, points):
    """(P,) distance of points to the nearest wall or solid's hull, negative inside or outside.

    In a room of several boxes, the distance to the walls is that of the best box: never too large.
    """
    out = np.empty(len(points))
    for p in range(len(points)):
        x = points[p, 0]
        y = points[p, 1]
        z = points[p, 2]
        free = -np.inf
        for r in range(len(geometry.rooms)):
            inner = min(x - geometry.rooms[r, 0, 0], geometry.rooms[r, 1, 0] - x)
            inner = min(inner, y - geometry.rooms[r, 0, 1], geometry.rooms[r, 1, 1] - y)
            inner = min(inner, z - geometry.rooms[r, 0, 2], geometry.rooms[r, 1, 2] - z)
            free = max(free, inner)
        for n in range(len(geometry.kind)):
            outer = 0.0
            inner = -np.inf
            for i in range(3):
                a = geometry.rotation[n, i, 0] * (x - geometry.centre[n, 0])
                a += geometry.rotation[n, i, 1] * (y - geometry.centre[n, 1])
                a += geometry.rotation[n, i, 2] * (z - geometry.centre[n, 2])
                over = abs(a) - geometry.half[n, i]
                outer += max(over, 0.0) ** 2
                inner = max(inner, over)
            free = min(free, np.sqrt(outer) if outer > 0 else inner)
        out[p] = free
    return out
