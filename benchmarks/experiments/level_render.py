"""Pictures and exact depth of a level, by rays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.experiments.level_textures import Textures
from benchmarks.experiments.quake_levels import LIGHTMAP, Level
from gvtools.cameras import Cameras

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
# Rays along each side of a pixel.
SUPERSAMPLE = 3
# Baked light is stored at half its brightness.
STORED_LIGHT = 2.0
SKY_COLOR = (0.45, 0.55, 0.7)


class LevelScene:
    """A level that rays can be cast into.

    Args:
        level: its triangles.
        textures: one picture a material.
    """

    def __init__(self, level: Level, textures: Textures) -> None:
        import open3d as o3d

        self.level, self._textures = level, textures
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(level.positions)),
            o3d.core.Tensor(level.triangles.astype(np.uint32)),
        )
        self._texels_per_unit = _texel_density(level, textures)

    def cast(self, origins: Float64, directions: Float64) -> tuple[Float32, NDArray[np.int64]]:
        """What rays meet.

        Args:
            origins: (N, 3).
            directions: (N, 3), of any length.

        Returns:
            (N,) distances in lengths of the directions, infinite where nothing is met, and the
            triangles, -1 there and at the sky.
        """
        found = self._cast(origins, directions)
        return found["t_hit"].numpy(), self._solid(found["primitive_ids"].numpy())

    def render(self, cameras: Cameras) -> tuple[Float32, Float32]:
        """Brightness and z-depth that cameras see.

        Args:
            cameras: V of one size.

        Returns:
            (V, H, W, 3) colours, which may exceed 1, and (V, H, W) z-depth at the pixels' centres,
            0 at the sky.
        """
        colors, depths = [], []
        for index in range(len(cameras)):
            camera = cameras[index]
            depth, hit = self.cast(*_rays(camera))
            depths.append(np.where(hit >= 0, depth, 0).reshape(_size(camera)))
            height, width = _size(camera)
            fine = camera.resized(width * SUPERSAMPLE, height * SUPERSAMPLE)
            tiles = self._colors(fine).reshape(height, SUPERSAMPLE, width, SUPERSAMPLE, 3)
            colors.append(tiles.mean((1, 3)))
        return np.stack(colors), np.stack(depths).astype(np.float32)

    def _colors(self, camera: Cameras) -> Float32:
        """(H W, 3) of one camera, a ray a pixel."""
        found = self._cast(*_rays(camera))
        triangle = self._solid(found["primitive_ids"].numpy())
        colors = np.tile(np.array(SKY_COLOR, np.float32), (len(triangle), 1))
        seen = triangle >= 0
        if not seen.any():
            return colors
        level, triangle = self.level, triangle[seen]
        second, third = found["primitive_uvs"].numpy()[seen].T
        shares = np.stack([1 - second - third, second, third], axis=1)
        corners = level.triangles[triangle]
        uv, light_uv, baked = (
            np.einsum("nk,nkc->nc", shares, values[corners])
            for values in (level.uv, level.light_uv, level.colors)
        )
        width = found["t_hit"].numpy()[seen] / camera.K[0, 0, 0]
        texels = width * self._texels_per_unit[triangle]
        picture = self._textures.read(level.material[triangle], uv, texels)
        lightmap = level.lightmap[triangle]
        lit = lightmap >= 0
        light = baked
        light[lit] = _bilinear(level.lightmaps, lightmap[lit], light_uv[lit])
        colors[seen] = picture * light * STORED_LIGHT
        return colors

    def _cast(self, origins: Float64, directions: Float64):
        import open3d as o3d

        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        return self._scene.cast_rays(o3d.core.Tensor(rays))

    def _solid(self, triangle: NDArray[np.uint32]) -> NDArray[np.int64]:
        """Triangles, -1 for none and for the sky."""
        found = np.where(triangle == np.iinfo(np.uint32).max, -1, triangle.astype(np.int64))
        met = found >= 0
        found[met] = np.where(self.level.sky[self.level.material[found[met]]], -1, found[met])
        return found


def _size(camera: Cameras) -> tuple[int, int]:
    return int(camera.height[0]), int(camera.width[0])


def _rays(camera: Cameras) -> tuple[Float64, Float64]:
    """Origins and directions (H W, 3) in the world; a length of 1 is a z-depth of 1."""
    directions = camera.rays().reshape(-1, 3) @ camera.world_from_cam[0, :3, :3].T
    return np.broadcast_to(camera.centers[0], directions.shape), directions


def _texel_density(level: Level, textures: Textures) -> Float64:
    """(T,) texels along a unit of length, of each triangle."""
    sizes = textures.sizes[level.material, 0]
    corners = level.positions[level.triangles].astype(np.float64)
    places = level.uv[level.triangles].astype(np.float64) * sizes[:, None]
    first, second = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    texels = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    return np.sqrt(texels / np.maximum(area, 1e-9))


def _bilinear(maps: NDArray[np.uint8], row: NDArray[np.int64], uv: Float32) -> Float32:
    """(N, 3) in [0, 1]: lightmaps between their pixels."""
    place = np.clip(uv * LIGHTMAP - 0.5, 0, LIGHTMAP - 1)
    low = np.minimum(place.astype(np.int64), LIGHTMAP - 2)
    share = (place - low).astype(np.float32)
    total = np.zeros((len(row), 3), np.float32)
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1])
            total += weight[:, None] * maps[row, low[:, 1] + dy, low[:, 0] + dx]
    return total / np.float32(255)
