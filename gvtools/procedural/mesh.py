"""Procedural geometry as triangles: boxes exactly, balls and tubes to a thousandth of their radius.

Rooms that are joined, and boxes less others, are cut into cells by all of their faces' planes; what
lies between a filled and an empty cell is surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.procedural.geometry import BALL, BOX, Geometry, Solid

if TYPE_CHECKING:
    from open3d.t.geometry import TriangleMesh

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Kinds of surface beside 0, 1, 2: flat, across that axis of the solid's frame.
ROUND, SIDE = 3, 4
SEGMENTS = 96  # of a ball's or tube's circumference


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, and what each of them belongs to.

    Attributes:
        corners: (T, 3, 3) world frame, metres.
        solid: (T,) its number; -1 for a wall.
        kind: (T,) axis of a flat surface in its solid's frame, ROUND or SIDE.
        material: (T,).
    """

    corners: Float64
    solid: Int64
    kind: Int64
    material: Int64


def mesh_of(geometry: Geometry) -> Mesh:
    """All surfaces of a scene."""
    parts = [_walls(geometry)]
    for number, solid in enumerate(geometry.solids):
        part = _box(solid) if solid.kind == BOX else _round(solid)
        corners = part.corners @ solid.rotation + solid.centre
        parts.append(Mesh(corners, np.full(len(corners), number), part.kind, part.material))
    return Mesh(
        np.concatenate([part.corners for part in parts]),
        np.concatenate([part.solid for part in parts]),
        np.concatenate([part.kind for part in parts]),
        np.concatenate([part.material for part in parts]),
    )


def _walls(geometry: Geometry) -> Mesh:
    edges = [np.unique(geometry.rooms[..., axis]) for axis in range(3)]
    centres = _centres(edges)
    inside = [((centres > low) & (centres < high)).all(-1) for low, high in geometry.rooms]
    squares, axis, side, cell = _boundary(np.any(inside, axis=0), edges)
    # The first of several rooms that share a place: its materials.
    room = np.argmax(inside, axis=0)[tuple(cell.T)]
    material = geometry.room_material[room, 2 * axis + side]
    return _triangles(squares, np.full(len(axis), -1), axis, material)


def _box(solid: Solid) -> Mesh:
    corners = np.concatenate([[-solid.half, solid.half], solid.cuts.reshape(-1, 3)])
    corners = np.clip(corners, -solid.half, solid.half)
    edges = [np.unique(corners[:, axis]) for axis in range(3)]
    centres = _centres(edges)
    filled = np.ones(centres.shape[:3], bool)
    for low, high in solid.cuts:
        filled &= ~((centres > low) & (centres < high)).all(-1)
    squares, axis, _, _ = _boundary(filled, edges)
    place = np.take_along_axis(squares[:, 0], axis[:, None], 1)[:, 0]
    own = np.abs(place) == solid.half[axis]
    material = np.where(own, solid.material, solid.cut_material)
    return _triangles(squares, axis, axis, material)


def _centres(edges: list[Float64]) -> Float64:
    """(A, B, C, 3) middles of the cells between planes."""
    middles = [(values[1:] + values[:-1]) / 2 for values in edges]
    return np.stack(np.meshgrid(*middles, indexing="ij"), -1)


class _Squares(NamedTuple):
    """Squares between filled and other cells.

    Attributes:
        corners: (S, 4, 3).
        axis: (S,) across the square.
        side: (S,) of the filled cell that the square is, 0 low or 1 high.
        cell: (S, 3) the filled cell.
    """

    corners: Float64
    axis: Int64
    side: Int64
    cell: Int64


def _boundary(filled: NDArray[np.bool_], edges: list[Float64]) -> _Squares:
    parts = []
    for axis in range(3):
        for side in range(2):
            beyond = np.roll(filled, 1 - 2 * side, axis)
            np.moveaxis(beyond, axis, 0)[-side] = False
            cell = np.argwhere(filled & ~beyond)
            first, second = (other for other in range(3) if other != axis)
            corners = np.repeat(cell[:, None], 4, axis=1)
            corners[..., axis] += side
            corners[:, (1, 2), first] += 1
            corners[:, (2, 3), second] += 1
            places = np.stack([edges[k][corners[..., k]] for k in range(3)], -1)
            parts.append((places, np.full(len(cell), axis), np.full(len(cell), side), cell))
    return _Squares(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _triangles(squares: Float64, solid: Int64, kind: Int64, material: Int64) -> Mesh:
    corners = squares[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    return Mesh(corners, np.repeat(solid, 2), np.repeat(kind, 2), np.repeat(material, 2))


def _round(solid: Solid) -> Mesh:
    """A ball, or what is left of it beside its first cut; a tube is never cut."""
    corners = _unit_body(solid.kind)
    if len(solid.cuts):
        corners = _less_box(corners, solid.cuts[0] / solid.half)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = np.abs((across * corners.mean(1)).sum(-1))
    outwards /= np.linalg.norm(across, axis=-1) * np.linalg.norm(corners.mean(1), axis=-1)
    kind = np.abs(across).argmax(-1)
    if solid.kind == BALL:
        kind = np.where(outwards > 0.95, ROUND, kind)
        material = np.where(kind == ROUND, solid.material, solid.cut_material)
    else:
        kind = np.where(kind == 2, 2, SIDE)
        material = np.full(len(kind), solid.material)
    return Mesh(corners * solid.half, kind, kind, material)


@cache
def _unit_body(kind: int) -> Float64:
    """(T, 3, 3) triangles of a ball of radius 1, or of a tube of radius 1 and height 2."""
    from open3d.t.geometry import TriangleMesh

    if kind == BALL:
        return _corners(TriangleMesh.create_sphere(1.0, SEGMENTS // 2))
    return _corners(TriangleMesh.create_cylinder(1.0, 2.0, SEGMENTS, 1))


def _corners(body: TriangleMesh) -> Float64:
    """(T, 3, 3), a copy; none of an empty mesh, which has no attributes."""
    if "indices" not in body.triangle:
        return np.empty((0, 3, 3))
    return body.vertex.positions.numpy().astype(np.float64)[body.triangle.indices.numpy()]


def triangle_mesh(corners: Float64) -> TriangleMesh:
    """Triangles (T, 3, 3) for Open3D."""
    from open3d.t.geometry import TriangleMesh

    positions = corners.reshape(-1, 3).astype(np.float32)
    return TriangleMesh(positions, np.arange(len(positions)).reshape(-1, 3))


def _less_box(ball: Float64, box: Float64) -> Float64:
    """(T, 3, 3) the unit ball less a box, with the faces of the cut."""
    planes = [
        (corner * unit, sign * unit)
        for corner, sign in zip(box, (-1.0, 1.0), strict=True)
        for unit in np.eye(3)
        if abs(corner @ unit) < 1
    ]
    kept, rest = [], triangle_mesh(ball)
    for number, (point, outwards) in enumerate(planes):
        kept.append(rest.clip_plane(point, outwards))
        rest = rest.clip_plane(point, -outwards)
        face = _disc(point, outwards)
        for other, (through, away) in enumerate(planes):
            if other != number and len(_corners(face)):
                face = face.clip_plane(through, -away)
        kept.append(face)
    return np.concatenate([_corners(part) for part in kept])


def _disc(point: Float64, normal: Float64) -> TriangleMesh:
    """The unit ball's section through a point on an axis, across that axis."""
    from open3d.t.geometry import TriangleMesh

    angle = np.linspace(0, 2 * np.pi, SEGMENTS + 1)
    axis = int(np.abs(normal).argmax())
    rim = np.zeros((SEGMENTS + 1, 3))
    radius = np.sqrt(1 - point[axis] ** 2)
    rim[:, axis - 2], rim[:, axis - 1] = radius * np.cos(angle), radius * np.sin(angle)
    rim[:, axis] = point[axis]
    positions = np.concatenate([point[None], rim]).astype(np.float32)
    first = np.arange(1, SEGMENTS + 1)
    return TriangleMesh(positions, np.stack([0 * first, first, first + 1], -1))
