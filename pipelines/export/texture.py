"""The texture of a mesh, from the photographs of the memory's observed views.

Each pair of triangles gets its own square of the texture, of one of a few sizes. Unwrapping would
give larger connected charts, but fails on meshes of noisy depth: Open3D's UVAtlas refuses edges
that three triangles share, and xatlas takes 20 s for 50 000 triangles and is one more package.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.capture.photographs import sharpness
from gvtools.errors import OptionError
from gvtools.o3d import o3d

Float32 = NDArray[np.float32]
Shot = tuple[Cameras, NDArray[np.uint8]]

# Sides of the squares [texels]. A triangle's legs are RIM texels shorter than its square's side, so
# that bilinear lookup at its border does not reach the square's other triangle.
SIDES = np.array([6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 96, 128, 192, 256])
RIM = 3.5
# Texels whose positions are computed at a time.
AT_ONCE = 500_000
# Without --max-triangles a mesh is simplified until each triangle has so many texels.
TEXELS = 80
# A texel is hidden in a view if the mesh's depth there is smaller by more than this share.
HIDDEN = 0.02
# Nearer than FADE to its border or EDGE to a depth edge [px], a photograph weighs less: with a pose
# error it shows another surface there.
FADE, EDGE = 24, 5
# Weights are raised to this power, so that the best view dominates and details are not blurred.
SHARPEN = 4


@dataclass(frozen=True, eq=False)
class Texture:
    """A texture and the triangles' places in it."""

    corners: NDArray[np.float64]  # (F, 3, 2) x and y, texels from the upper left corner
    image: NDArray[np.uint8]  # (S, S, 3)

    @property
    def uv(self) -> NDArray[np.float64]:
        """(F, 3, 2) texture coordinates from 0 to 1, from the lower left corner."""
        return np.array([0.0, 1.0]) + self.corners / len(self.image) * [1.0, -1.0]


def texture_of(mesh: o3d.t.geometry.TriangleMesh, shots: Iterable[Shot], size: int) -> Texture:
    """The texture of a mesh from photographs, and from its vertex colours where none sees it.

    Cameras of the ``shots`` are in the mesh's frame; ``size`` is the texture's side, texels.
    """
    vertices = mesh.vertex.positions.numpy().astype(np.float64)
    faces = mesh.triangle.indices.numpy()
    corners = atlas(vertices[faces], size)
    face, weights = _texels(corners, size)
    used = face >= 0
    points = _between(vertices, faces[face[used]], weights[used])
    plain = _between(mesh.vertex.colors.numpy(), faces[face[used]], weights[used]) * 255
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sums = np.zeros((len(points), 4), np.float32)
    # Vertex colours get so small a weight that any photograph outweighs them.
    sums[:, :3], sums[:, 3] = 1e-9 * plain, 1e-9
    _add_photographs(
        sums, mesh, points, normals=normals[face[used]].astype(np.float32), shots=shots
    )
    image = np.zeros((size, size, 3), np.uint8)
    image[used] = np.clip(np.rint(sums[:, :3] / sums[:, 3:]), 0, 255)
    return Texture(corners, image)


def atlas(triangles: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Texture positions (F, 3, 2), in texels, of the corners of triangles (F, 3, 3).

    A triangle becomes half a square with its longest edge as the diagonal; the square's side is
    chosen by the length of that edge.
    """
    lengths = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
    legs = lengths.max(axis=1) / np.sqrt(2)
    sides = SIDES[size // 2 >= SIDES]
    smallest = np.full(len(legs), sides[0])
    if _height(smallest, size) > size:
        most = 2 * (size // int(sides[0])) ** 2
        raise OptionError(
            f"--texture {size}: the mesh has {len(legs)} triangles; expected at most {most}; give "
            f"--max-triangles {size**2 // TEXELS} or a larger texture"
        )
    # Bisect the largest number of texels per scene unit that fits.
    low, high = 0.0, float(sides[-1] / max(legs.max(), 1e-12)) * 64
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if _height(_sides(legs, middle, sides), size) <= size else (
            low, middle)  # fmt: skip
    side = _sides(legs, low, sides)
    return _placed(side, lengths.argmax(axis=1), size)


def _sides(legs: NDArray[np.float64], scale: float, sides: NDArray[np.int64]) -> NDArray[np.int64]:
    rows = np.searchsorted(sides, legs * scale + RIM)
    return np.asarray(sides[np.minimum(rows, len(sides) - 1)])


def _height(side: NDArray[np.int64], size: int) -> int:
    """Texels that rows of squares of these sides take, two triangles a square."""
    sides, count = np.unique(side, return_counts=True)
    lines = np.ceil(np.ceil(count / 2) / (size // sides))
    return int((lines * sides).sum())


def _placed(side: NDArray[np.int64], longest: NDArray[np.int64], size: int) -> NDArray[np.float64]:
    corners = np.empty((len(side), 3, 2))
    top = 0
    for s in np.unique(side)[::-1]:
        rows = np.flatnonzero(side == s)
        square, second = np.divmod(np.arange(len(rows)), 2)
        line, column = np.divmod(square, size // s)
        origin = np.stack([column * s, top + line * s], axis=1).astype(np.float64)
        leg = s - RIM
        first = np.array([[1 + leg, 1], [1, 1 + leg], [1, 1]])
        shapes = np.stack([first, s - first])[second] + origin[:, None]
        # Corner k of a shape: the ends of the longest edge, then the one opposite to it.
        order = (longest[rows, None] + np.arange(3)) % 3
        corners[rows[:, None], order] = shapes
        top += int(line[-1] + 1) * s
    return corners


def _texels(corners: NDArray[np.float64], size: int) -> tuple[NDArray[np.int64], Float32]:
    """(S, S) the triangle of each texel, -1 for none, and (S, S, 3) barycentric coordinates."""
    face = np.full((size, size), -1, np.int64)
    weights = np.zeros((size, size, 3), np.float32)
    least = np.floor(corners.min(axis=1))
    sides = np.rint(corners[..., 0].max(axis=1) - corners[..., 0].min(axis=1) + RIM).astype(int)
    for s in np.unique(sides):
        rows = np.flatnonzero(sides == s)
        y, x = (each.ravel() for each in np.mgrid[:s, :s])
        for second in (False, True):
            # The second triangle of a square has its right angle at the lower right.
            middle = corners[rows].mean(axis=1) - corners[rows].min(axis=1)
            of_shape = rows[(middle[:, 0] > (s - RIM) / 2) == second]
            inside = (x + y + 1 > s) if second else (x + y + 1 <= s)
            offset = np.stack([x[inside], y[inside]], axis=1)
            step = max(1, AT_ONCE // s**2)
            for first in range(0, len(of_shape), step):
                some = of_shape[first : first + step]
                at = least[some, None] - (2 if second else 1) + offset
                column, line = at[..., 0].astype(int), at[..., 1].astype(int)
                face[line, column] = some[:, None]
                weights[line, column] = _barycentric(corners[some], at + 0.5)
    return face, weights


def _barycentric(corners: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """(F, N, 3) barycentric coordinates of points (F, N, 2) in triangles (F, 3, 2), clipped."""
    a, b, c = (corners[:, None, k] for k in range(3))
    area = _cross(b - a, c - a)
    u, v = _cross(at - a, c - a) / area, _cross(b - a, at - a) / area
    weights = np.clip(np.stack([1 - u - v, u, v], axis=-1), 0, None)
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True))


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _between(values: NDArray[np.floating], rows: NDArray[np.int64], weights: Float32) -> Float32:
    """(N, C) of values (V, C) at corners (N, 3) with weights (N, 3)."""
    out = np.zeros((len(rows), values.shape[1]), np.float32)
    for k in range(3):
        out += values[rows[:, k]].astype(np.float32) * weights[:, k, None]
    return out


def _add_photographs(
    sums: Float32,
    mesh: o3d.t.geometry.TriangleMesh,
    points: Float32,
    *,
    normals: Float32,
    shots: Iterable[Shot],
) -> None:
    """Add each photograph's colours of points (N, 3) to ``sums``.

    ``sums`` (N, 4) holds the weighted sum of colours and the sum of weights.
    """
    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles(
        mesh.vertex.positions.to(o3d.core.float32), mesh.triangle.indices.to(o3d.core.uint32)
    )
    for camera, picture in shots:
        pose = camera.cam_from_world[0]
        height, width = picture.shape[:2]
        depth = rays.cast_rays(
            rays.create_rays_pinhole(
                o3d.core.Tensor(camera.K[0]), o3d.core.Tensor(pose), width, height
            )
        )["t_hit"].numpy()
        local = points @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3].astype(np.float32)
        z = np.maximum(local[:, 2], 1e-9)
        xy = (local[:, :2] / z[:, None]) @ camera.K[0, :2, :2].T.astype(np.float32)
        xy += camera.K[0, :2, 2].astype(np.float32)
        facing = -(local * (normals @ pose[:3, :3].T.astype(np.float32))).sum(axis=1)
        seen = (local[:, 2] > 0) & (xy > 0).all(axis=1) & (xy < [width, height]).all(axis=1)
        seen &= facing > 0
        rows = np.flatnonzero(seen)
        column, line = (xy[rows] - 0.5).T.astype(np.float32)
        near = xy[rows].astype(np.int64)
        rows_seen = local[rows, 2] <= depth[near[:, 1], near[:, 0]] * (1 + HIDDEN)
        rows, column, line, near = (each[rows_seen] for each in (rows, column, line, near))
        if not len(rows):
            continue
        cosine = facing[rows] / np.linalg.norm(local[rows], axis=1)
        weight = sharpness(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)) ** 0.25 * cosine / z[rows]
        weight = (weight * _trust(depth)[near[:, 1], near[:, 0]]) ** SHARPEN
        # Texels as a picture of one column, in parts of 30 000: remap allows no more than 32 767.
        color = np.concatenate([
            cv2.remap(picture, column[a : a + 30_000, None], line[a : a + 30_000, None],
                      cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
            for a in range(0, len(rows), 30_000)
        ])  # fmt: skip
        sums[rows, :3] += color * weight[:, None]
        sums[rows, 3] += weight


def _trust(depth: Float32) -> Float32:
    """(H, W) weights of pixels, 0.05 to 1, by the distance to the border and to depth edges."""
    known = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    smooth = cv2.dilate(known, kernel) - cv2.erode(known, kernel) <= 0.05 * known
    smooth[[0, -1]] = smooth[:, [0, -1]] = False
    apart = cv2.distanceTransform(smooth.astype(np.uint8), cv2.DIST_L2, 3)
    border = np.ones(depth.shape, np.uint8)
    border[[0, -1]] = border[:, [0, -1]] = 0
    inside = cv2.distanceTransform(border, cv2.DIST_L2, 3)
    return np.clip(np.minimum(apart / EDGE, inside / FADE), 0.05, 1).astype(np.float32)
