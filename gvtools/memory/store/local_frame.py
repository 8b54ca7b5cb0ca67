"""The frame that a memory keeps its points in: an origin and axes of its own in the world.

With the origin near the scene, float32 keeps its digits in a georeferenced world. With origin and
axes that go with the scene (a camera's), the voxel grid does, too: then what is stored and shown
does not depend on how the world frame happens to lie.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ShapeError

Float64 = NDArray[np.float64]
# Of an entry of axes^T axes from the identity's.
ORTHONORMAL = 1e-9


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """world = origin + axes local."""

    # (3,) world frame, scene units; (3, 3), the columns are the local axes in the world frame.
    origin: Float64
    axes: Float64

    @classmethod
    def at(cls, origin: ArrayLike = (0.0, 0.0, 0.0), axes: ArrayLike | None = None) -> LocalFrame:
        """The frame of an origin and axes; None for the world's."""
        point = np.array(origin, np.float64)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise ShapeError(f"memory origin {point.tolist()}; expected three finite numbers")
        turn = np.eye(3) if axes is None else np.array(axes, np.float64)
        square = turn.shape == (3, 3) and np.allclose(turn.T @ turn, np.eye(3), atol=ORTHONORMAL)
        if not square or np.linalg.det(turn) < 0:
            raise ShapeError(f"memory axes {turn.tolist()}; expected a (3, 3) rotation")
        return cls(point, turn)

    @classmethod
    def of_camera(cls, camera: Cameras) -> LocalFrame:
        """The frame of a camera (a batch of one), its rotation made exact."""
        pose = camera.world_from_cam[0]
        u, _, v = np.linalg.svd(pose[:3, :3])
        return cls.at(pose[:3, 3], u @ v)

    def same_as(self, other: LocalFrame) -> bool:
        """Whether both are the same to the last bit."""
        return np.array_equal(self.origin, other.origin) and np.array_equal(self.axes, other.axes)

    def to_world(self, positions: ArrayLike) -> Float64:
        """(N, 3) local positions in the world frame."""
        return np.asarray(positions, np.float64) @ self.axes.T + self.origin

    def from_world(self, positions: ArrayLike) -> Float64:
        """(N, 3) world positions in this frame."""
        return (np.asarray(positions, np.float64) - self.origin) @ self.axes

    def cam_from_local(self, cam_from_world: Float64) -> Float64:
        """(V, 4, 4) poses of cameras with respect to this frame."""
        local = cam_from_world.copy()
        # x_cam = R x_world + t = R (axes x_local + origin) + t
        local[:, :3, 3] += cam_from_world[:, :3, :3] @ self.origin
        local[:, :3, :3] = cam_from_world[:, :3, :3] @ self.axes
        return local

    def cam_from_world(self, cam_from_local: Float64) -> Float64:
        """(V, 4, 4) poses in the world of cameras given in this frame: of ``cam_from_local``."""
        world = cam_from_local.copy()
        world[:, :3, :3] = cam_from_local[:, :3, :3] @ self.axes.T
        world[:, :3, 3] = cam_from_local[:, :3, 3] - world[:, :3, :3] @ self.origin
        return world

    def local_from_cam(self, world_from_cam: Float64) -> Float64:
        """(4, 4) from one camera to this frame."""
        local = world_from_cam.copy()
        local[:3, 3] -= self.origin
        local[:3] = self.axes.T @ local[:3]
        return local

    def seen_from(self, cameras: Cameras) -> Cameras:
        """The cameras with this frame in the place of the world's."""
        pose = self.cam_from_local(cameras.cam_from_world)
        return Cameras(cameras.K, pose, cameras.width, cameras.height, names=cameras.names)
