"""Analytic surfaces seen by a pinhole camera: exact depth, filtered texture, baked light.

A surface is a patch with parameters (s, t) in [0, 1]². Flat patches are hit through the plane's
homography, curved ones by their quadric, each only inside the image window that it can cover.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.scenes.room_textures import Texture, average_blocks, encode_srgb

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]

NEAREST = 1e-3  # what lies closer to a camera than this is not drawn, scene units


@dataclass(frozen=True, eq=False)
class Grid:
    """Sample positions of one image: ``supersample``² to a pixel.

    Attributes:
        K: (3, 3) of the camera, pixels.
        rotation: (3, 3) cam_from_world.
        center: (3,) projection centre, world frame.
        x: (w,) horizontal sample positions, pixels.
        y: (h,) vertical sample positions, pixels.
        supersample: samples along a pixel's side.
    """

    K: Float64
    rotation: Float64
    center: Float64
    x: Float64
    y: Float64
    supersample: int

    def window(self, patch: Patch) -> tuple[slice, slice]:
        """Rows and columns that a patch can cover."""
        local = (patch.hull() - self.center) @ self.rotation.T
        everything = slice(0, len(self.y)), slice(0, len(self.x))
        if patch.averted(self.center) or (local[:, 2] < NEAREST).all():
            return slice(0, 0), slice(0, 0)
        if (local[:, 2] < NEAREST).any():
            return everything
        xy = local @ self.K.T
        xy = xy[:, :2] / xy[:, 2:] * self.supersample
        low, high = np.floor(xy.min(0)) - 1, np.ceil(xy.max(0)) + 1
        limit = np.array([len(self.x), len(self.y)])
        (left, top), (right, bottom) = np.clip([low, high], 0, limit).astype(int)
        return slice(top, bottom), slice(left, right)

    def directions(
        self, rows: NDArray[np.intp] | slice, columns: NDArray[np.intp] | slice
    ) -> Float64:
        """(..., 3) world directions whose length is 1 in z-depth, over rows x columns."""
        x = (self.x[columns] - self.K[0, 2]) / self.K[0, 0]
        y = (self.y[rows] - self.K[1, 2]) / self.K[1, 1]
        if isinstance(rows, slice):
            x, y = np.broadcast_arrays(x[None, :], y[:, None])
        return np.stack([x, y, np.ones_like(x)], -1) @ self.rotation


@dataclass(frozen=True, eq=False)
class Patch:
    """What all surfaces carry.

    Attributes:
        texture: what is painted on it.
        tiles: how often the texture repeats along s and along t.
        emission: added to the light that falls on it; 0 for all but lamps.
    """

    texture: Texture
    tiles: tuple[float, float]
    emission: float

    @property
    def size(self) -> tuple[float, float]:
        """Length along s and along t, scene units."""
        raise NotImplementedError

    def hull(self) -> Float64:
        """(N, 3) points whose convex hull holds the patch."""
        raise NotImplementedError

    def averted(self, center: Float64) -> bool:
        """Whether nothing of it can be seen from a (3,) place, being behind it."""
        return False

    def hit(self, grid: Grid, rows: slice, columns: slice) -> tuple[Float64, Float64, Float64]:
        """z-depth (infinity where missed), s and t, each (h, w), for a window of the grid."""
        raise NotImplementedError

    def at(self, s: Float64, t: Float64) -> tuple[Float64, Float64]:
        """(..., 3) positions and unit normals."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Flat(Patch):
    """A parallelogram ``origin + s u + t v``, or the ellipse inside it.

    It is seen from the side where u runs to the right and v downwards; from behind it is not there.
    """

    origin: Float64
    u: Float64
    v: Float64
    round: bool = False

    @cached_property
    def normal(self) -> Float64:
        """(3,) of unit length, towards where it is seen from."""
        normal = np.cross(self.v, self.u)
        return normal / np.linalg.norm(normal)

    @property
    def size(self) -> tuple[float, float]:  # noqa: D102
        return float(np.linalg.norm(self.u)), float(np.linalg.norm(self.v))

    def hull(self) -> Float64:  # noqa: D102
        return self.origin + np.array([0 * self.u, self.u, self.v, self.u + self.v])

    def averted(self, center: Float64) -> bool:  # noqa: D102
        return bool(self.normal @ (center - self.origin) <= 0)

    def hit(self, grid: Grid, rows: slice, columns: slice) -> tuple[Float64, Float64, Float64]:  # noqa: D102
        x, y = grid.x[columns][None, :], grid.y[rows][:, None]
        plane = grid.rotation @ np.stack([self.u, self.v, self.origin - grid.center], axis=1)
        H = np.linalg.inv(grid.K @ plane)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            z = np.where(inverse > 0, 1 / inverse, np.inf)
            s = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) * z
            t = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) * z
            inside = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
            if self.round:
                inside &= (s - 0.5) ** 2 + (t - 0.5) ** 2 <= 0.25
        return np.where(inside, z, np.inf), s, t

    def at(self, s: Float64, t: Float64) -> tuple[Float64, Float64]:  # noqa: D102
        position = self.origin + s[..., None] * self.u + t[..., None] * self.v
        return position, np.broadcast_to(self.normal, position.shape)


@dataclass(frozen=True, eq=False)
class Ball(Patch):
    """A sphere; s runs round the vertical axis, t from the top down."""

    center: Float64
    radius: float

    @property
    def size(self) -> tuple[float, float]:  # noqa: D102
        return 2 * np.pi * self.radius, np.pi * self.radius

    def hull(self) -> Float64:  # noqa: D102
        signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
        return self.center + self.radius * signs

    def hit(self, grid: Grid, rows: slice, columns: slice) -> tuple[Float64, Float64, Float64]:  # noqa: D102
        ray = grid.directions(rows, columns)
        offset = grid.center - self.center
        squared = np.einsum("hwi,hwi->hw", ray, ray)
        z = _first_root(squared, ray @ offset, float(offset @ offset) - self.radius**2)
        with np.errstate(invalid="ignore"):
            normal = (offset + z[..., None] * ray) / self.radius
        s = np.arctan2(normal[..., 1], normal[..., 0]) / (2 * np.pi) + 0.5
        t = np.arccos(np.clip(normal[..., 2], -1, 1)) / np.pi
        return z, s, t

    def at(self, s: Float64, t: Float64) -> tuple[Float64, Float64]:  # noqa: D102
        azimuth, polar = 2 * np.pi * (s - 0.5), np.pi * t
        flat = np.sin(polar)
        normal = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(polar)], -1)
        return self.center + self.radius * normal, normal


@dataclass(frozen=True, eq=False)
class Tube(Patch):
    """The side of a vertical cylinder; s runs round it, t from the top down."""

    foot: Float64
    radius: float
    height: float

    @property
    def size(self) -> tuple[float, float]:  # noqa: D102
        return 2 * np.pi * self.radius, self.height

    def hull(self) -> Float64:  # noqa: D102
        r, h = self.radius, self.height
        return self.foot + np.array([(x, y, z) for x in (-r, r) for y in (-r, r) for z in (0, h)])

    def hit(self, grid: Grid, rows: slice, columns: slice) -> tuple[Float64, Float64, Float64]:  # noqa: D102
        ray = grid.directions(rows, columns)
        offset = grid.center - self.foot
        across = ray[..., :2]
        z = _first_root(
            np.einsum("hwi,hwi->hw", across, across),
            across @ offset[:2],
            float(offset[:2] @ offset[:2]) - self.radius**2,
        )
        with np.errstate(invalid="ignore"):
            x, y, up = np.moveaxis(offset + z[..., None] * ray, -1, 0)
            z = np.where((up >= 0) & (up <= self.height), z, np.inf)
        return z, np.arctan2(y, x) / (2 * np.pi) + 0.5, 1 - up / self.height

    def at(self, s: Float64, t: Float64) -> tuple[Float64, Float64]:  # noqa: D102
        azimuth = 2 * np.pi * (s - 0.5)
        normal = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], -1)
        position = self.foot + self.radius * normal
        position[..., 2] += (1 - t) * self.height
        return position, normal


def _first_root(a: Float64, b: Float64, c: float) -> Float64:
    """The smaller root of a z² + 2 b z + c, infinity where there is none in front."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (-b - np.sqrt(b * b - a * c)) / a
        return np.where(z > NEAREST, z, np.inf)


@dataclass(frozen=True, eq=False)
class Hits:
    """What each sample of a grid sees first; -1 and infinity where nothing is hit.

    Attributes:
        patch: (h, w) int16, index into the patches.
        z: (h, w) float64 z-depth, scene units.
        s: (h, w) float64, the patch's first parameter.
        t: (h, w) float64, its second.
    """

    patch: NDArray[np.int16]
    z: Float64
    s: Float64
    t: Float64


def cast(patches: Sequence[Patch], camera: Cameras, *, supersample: int = 1) -> tuple[Grid, Hits]:
    """What one camera (a batch of one) sees at each sample position."""
    width, height = int(camera.width[0]), int(camera.height[0])
    grid = Grid(
        K=camera.K[0],
        rotation=camera.cam_from_world[0, :3, :3],
        center=camera.centers[0],
        x=(np.arange(width * supersample) + 0.5) / supersample,
        y=(np.arange(height * supersample) + 0.5) / supersample,
        supersample=supersample,
    )
    shape = len(grid.y), len(grid.x)
    hits = Hits(
        np.full(shape, -1, np.int16), np.full(shape, np.inf), np.zeros(shape), np.zeros(shape)
    )
    for index, patch in enumerate(patches):
        rows, columns = grid.window(patch)
        if rows.stop <= rows.start or columns.stop <= columns.start:
            continue
        z, s, t = patch.hit(grid, rows, columns)
        nearer = z < hits.z[rows, columns]
        for target, value in ((hits.z, z), (hits.s, s), (hits.t, t)):
            np.copyto(target[rows, columns], value, where=nearer)
        hits.patch[rows, columns][nearer] = index
    return grid, hits


def shade(
    patches: Sequence[Patch], lights: Sequence[Float32], grid: Grid, hits: Hits
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 sRGB: texture times baked light, averaged over each pixel's samples."""
    flat = hits.patch.ravel()
    order = np.argsort(flat, kind="stable")
    start = np.searchsorted(flat[order], np.arange(len(patches) + 1))
    linear = np.zeros((flat.size, 3), np.float32)
    for index, (patch, light) in enumerate(zip(patches, lights, strict=True)):
        rows = order[start[index] : start[index + 1]]
        if not len(rows):
            continue
        s, t, z = hits.s.ravel()[rows], hits.t.ravel()[rows], hits.z.ravel()[rows]
        y, x = np.divmod(rows, len(grid.x))
        ray = grid.directions(y, x)
        _, normal = patch.at(s, t)
        facing = np.maximum(np.abs(np.einsum("ni,ni->n", normal, ray)), 1e-3)
        # The surface that one sample covers: z² dx dy / |n · ray|, ray of unit z-depth.
        side = z / (grid.supersample * np.sqrt(grid.K[0, 0] * grid.K[1, 1] * facing))
        color = patch.texture.sample(s * patch.tiles[0], t * patch.tiles[1], _texels(patch) * side)
        linear[rows] = color * (bilinear(light, s, t) + np.float32(patch.emission))
    return encode_srgb(average_blocks(linear.reshape(*hits.patch.shape, 3), grid.supersample))


def _texels(patch: Patch) -> float:
    """Texels of the finest level per scene unit, the mean of both directions."""
    height, width = patch.texture.levels[0].shape[:2]
    (length, breadth), (along, across) = patch.size, patch.tiles
    return float(np.sqrt(width * along / length * height * across / breadth))


def bilinear(values: Float32, s: Float64, t: Float64) -> Float32:
    """Samples of a (rows, columns, C) map of cell centres over [0, 1]², rows along t."""
    rows, columns = values.shape[:2]
    x = np.clip(s * columns - 0.5, 0, columns - 1)
    y = np.clip(t * rows - 0.5, 0, rows - 1)
    left = np.minimum(x.astype(np.intp), max(columns - 2, 0))
    top = np.minimum(y.astype(np.intp), max(rows - 2, 0))
    right, bottom = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    fx = (x - left).astype(np.float32)[:, None]
    fy = (y - top).astype(np.float32)[:, None]
    upper = values[top, left] * (1 - fx) + values[top, right] * fx
    lower = values[bottom, left] * (1 - fx) + values[bottom, right] * fx
    return upper * (1 - fy) + lower * fy
