"""Which surfaces of a procedural scene rays meet first: Open3D's ray casting (Embree)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.procedural.geometry import Geometry
from gvtools.procedural.mesh import mesh_of, triangle_mesh

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What the rays through pixel centres of V views meet.

    Attributes:
        depth: (V, H, W) float32 z-depth, metres; 0 where there is nothing.
        solid: (V, H, W) int64, -1 for a wall.
    """

    depth: Float32
    solid: NDArray[np.int64]


class Tracer:
    """A scene's triangles, ready to be met by rays."""

    def __init__(self, geometry: Geometry) -> None:
        self.mesh = mesh_of(geometry)
        self._all = _scene(self.mesh.corners)
        # The walls' number is the last.
        shades = np.array([*(solid.shades for solid in geometry.solids), True])
        self._shading = _scene(self.mesh.corners[shades[self.mesh.solid]])

    def first(self, rays: Float32) -> tuple[Float32, NDArray[np.int64], Float32]:
        """Where rays (..., 6), origin and direction, meet a triangle first.

        Returns:
            The rays' parameters (...,), infinity where there is nothing; the triangles' numbers
            (...,) and unit normals (..., 3).
        """
        from open3d.core import Tensor

        hits = self._all.cast_rays(Tensor(rays))
        triangle = hits["primitive_ids"].numpy().astype(np.int64)
        t = hits["t_hit"].numpy()
        return t, np.where(np.isfinite(t), triangle, 0), hits["primitive_normals"].numpy()

    def blocked(self, rays: Float32) -> NDArray[np.bool_]:
        """(...,) whether something that shades is on the way from origin to origin + direction."""
        from open3d.core import Tensor

        return self._shading.test_occlusions(Tensor(rays), 0.0, 1.0).numpy()


# As long as their scenes live: what Open3D holds at exit, it complains of.
_TRACERS: WeakKeyDictionary[Geometry, Tracer] = WeakKeyDictionary()


def tracer(geometry: Geometry) -> Tracer:
    """The tracer of a scene, made once for its path and its pictures."""
    if geometry not in _TRACERS:
        _TRACERS[geometry] = Tracer(geometry)
    return _TRACERS[geometry]


def cast(geometry: Geometry, cameras: Cameras) -> Surfaces:
    """The surfaces at the pixel centres of cameras of one size."""
    scene = tracer(geometry)
    rays = np.stack([world_rays(cameras, view) for view in range(len(cameras))])
    t, triangle, _ = scene.first(rays)
    return Surfaces(np.where(np.isfinite(t), t, np.float32(0)), scene.mesh.solid[triangle])


def world_rays(cameras: Cameras, view: int) -> Float32:
    """(H, W, 6) origins and directions of z-depth 1 of the rays through a view's pixel centres."""
    directions = cameras.rays(view) @ cameras.cam_from_world[view, :3, :3]
    origins = np.broadcast_to(cameras.centers[view], directions.shape)
    return np.concatenate([origins, directions], -1).astype(np.float32)


def _scene(corners: Float64) -> RaycastingScene:
    from open3d.t.geometry import RaycastingScene

    scene = RaycastingScene()
    scene.add_triangles(triangle_mesh(corners))
    return scene
