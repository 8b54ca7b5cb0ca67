"""Pinhole cameras: intrinsics, poses, rays, and the bookkeeping of resizing and cropping.

Conventions of the whole project: OpenCV axes (x right, y down, z forward); the centre of the first
pixel lies at (0.5, 0.5), as in COLMAP; ``depth`` is z-depth in scene units, 0 where there is none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ShapeError

Float64 = NDArray[np.float64]

# A rotation read from a file may be this far from orthonormal (largest entry of R Rᵀ − I) and is
# then replaced by the nearest rotation; beyond it, the matrix holds a scale, a shear or a mirror.
ROTATION_TOLERANCE = 5e-3
# A rotation nearer to orthonormal than this is as good as text with few digits can be.
ROTATION_ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class Cameras:
    """V pinhole cameras.

    Attributes:
        K: (V, 3, 3) float64, pixels; the first pixel's centre is (0.5, 0.5).
        cam_from_world: (V, 4, 4) float64, rigid, scene units.
        width: (V,) int64, pixels.
        height: (V,) int64, pixels.
        names: V view names; running numbers where none are given.

    Raises:
        ShapeError: arrays that do not fit each other.

    >>> camera = Cameras.pinhole(640, 480, focal=500.0)
    >>> xy, z = camera.project([[0.0, 0.0, 2.0]])  # a point 2 units ahead
    >>> xy[0, 0], z[0]
    (array([320., 240.]), array([2.]))
    >>> camera.resized(320, 240).K[0].diagonal()
    array([250., 250.,   1.])
    """

    K: Float64
    cam_from_world: Float64
    width: NDArray[np.int64]
    height: NDArray[np.int64]
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        K = np.asarray(self.K, np.float64)
        count = len(K)
        pose = np.asarray(self.cam_from_world, np.float64)
        if K.shape != (count, 3, 3) or pose.shape != (count, 4, 4):
            raise ShapeError(
                f"cameras: K {K.shape} and cam_from_world {pose.shape}; "
                "expected (V, 3, 3) and (V, 4, 4)"
            )
        for name, value in (
            ("K", K),
            ("cam_from_world", pose),
            ("width", np.broadcast_to(np.asarray(self.width, np.int64), (count,))),
            ("height", np.broadcast_to(np.asarray(self.height, np.int64), (count,))),
            ("names", tuple(self.names) or tuple(f"{i:06d}" for i in range(count))),
        ):
            object.__setattr__(self, name, value)
        if len(self.names) != count:
            raise ShapeError(f"cameras: {len(self.names)} names for {count} cameras")

    @staticmethod
    def pinhole(
        width: int,
        height: int,
        *,
        focal: float,
        cam_from_world: ArrayLike | None = None,
        name: str = "",
    ) -> Cameras:
        """One camera with square pixels and its principal point in the middle; lengths in pixels.

        ``cam_from_world`` is (4, 4), rigid, in scene units; None is the identity.
        """
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        pose = np.eye(4) if cam_from_world is None else cam_from_world
        return Cameras.alike(K, pose, size=(width, height), names=(name,) if name else ())

    @staticmethod
    def alike(
        K: ArrayLike, cam_from_world: ArrayLike, *, size: tuple[int, int], names: Sequence[str] = ()
    ) -> Cameras:
        """Cameras of one size, (width, height) in pixels, at (V, 4, 4) or (4, 4) poses.

        ``K`` is (V, 3, 3), or (3, 3) for all of them.
        """
        K, poses = np.asarray(K, np.float64), np.asarray(cam_from_world, np.float64)
        poses = poses[None] if poses.ndim == 2 else poses
        K = np.repeat(K[None], len(poses), axis=0) if K.ndim == 2 else K
        return Cameras(K, poses, np.array(size[0]), np.array(size[1]), tuple(names))

    def __len__(self) -> int:
        return len(self.K)

    def __iter__(self) -> Iterator[Cameras]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int | slice | Sequence[int]) -> Cameras:
        """The cameras at ``index`` (a number gives a batch of one)."""
        rows = np.atleast_1d(np.arange(len(self))[index])
        return Cameras(
            self.K[rows],
            self.cam_from_world[rows],
            self.width[rows],
            self.height[rows],
            tuple(self.names[i] for i in rows),
        )

    @property
    def world_from_cam(self) -> Float64:
        """(V, 4, 4) float64, the inverse poses."""
        return invert_rigid(self.cam_from_world)

    @property
    def centers(self) -> Float64:
        """(V, 3) float64, projection centres in the world frame, scene units."""
        return self.world_from_cam[:, :3, 3]

    def resized(self, width: int, height: int) -> Cameras:
        """The same cameras for images resampled to ``width`` x ``height`` pixels."""
        K = self.K.copy()
        K[:, 0] *= (width / self.width)[:, None]
        K[:, 1] *= (height / self.height)[:, None]
        return replace(self, K=K, width=np.array(width), height=np.array(height))

    def cropped(self, left: int, top: int, *, width: int, height: int) -> Cameras:
        """The same cameras for the window of the images that starts at (left, top), pixels."""
        K = self.K.copy()
        K[:, 0, 2] -= left
        K[:, 1, 2] -= top
        return replace(self, K=K, width=np.array(width), height=np.array(height))

    def project(self, points: ArrayLike) -> tuple[Float64, Float64]:
        """World points seen by each camera.

        Args:
            points: (N, 3), world frame, scene units.

        Returns:
            xy (V, N, 2) float64, pixels, and z (V, N) float64, scene units; xy is NaN where z <= 0.
        """
        points = np.asarray(points, np.float64)
        local = np.einsum("vij,nj->vni", self.cam_from_world[:, :3, :3], points)
        local += self.cam_from_world[:, None, :3, 3]
        z = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            homogeneous = np.einsum("vij,vnj->vni", self.K, local)
            xy = np.where(z[..., None] > 0, homogeneous[..., :2] / z[..., None], np.nan)
        return xy, z

    def rays(self, index: int = 0) -> Float64:
        """(H, W, 3) float64: for each pixel centre, the camera-frame point at depth z = 1."""
        x = np.arange(self.width[index]) + 0.5
        y = np.arange(self.height[index]) + 0.5
        check_usable(self[index])
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
        return grid @ np.linalg.inv(self.K[index]).T

    def plucker(self, index: int = 0) -> Float64:
        """(H, W, 6) float64 Plücker ray map: unit direction d and moment c x d, world frame."""
        direction = self.rays(index) @ self.world_from_cam[index, :3, :3].T
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        moment = np.cross(self.centers[index], direction)
        return np.concatenate([direction, moment], axis=-1)


def reduced_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Width and height of a picture, reduced to a longer side of ``longest`` where it is larger.

    >>> reduced_size(640, 480, 320), reduced_size(64, 48, 320)
    ((320, 240), (64, 48))
    """
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def check_usable(cameras: Cameras) -> None:
    """Refuse cameras that no picture can be taken with."""
    for camera in cameras:
        K, name = camera.K[0], camera.names[0]
        if not (np.isfinite(K).all() and np.isfinite(camera.cam_from_world).all()):
            raise ShapeError(f"{name}: its camera holds NaN or infinity; mend it or drop the view")
        width, height = int(camera.width[0]), int(camera.height[0])
        if not min(K[0, 0], K[1, 1], width, height) > 0:
            raise ShapeError(
                f"{name}: focal lengths {K[0, 0]:g} and {K[1, 1]:g} px and an image of {width} x "
                f"{height} pixels; expected positive ones"
            )


def concatenate(parts: Sequence[Cameras]) -> Cameras:
    """All cameras of ``parts``, in order."""
    return Cameras(
        np.concatenate([part.K for part in parts]),
        np.concatenate([part.cam_from_world for part in parts]),
        np.concatenate([part.width for part in parts]),
        np.concatenate([part.height for part in parts]),
        tuple(name for part in parts for name in part.names),
    )


def invert_rigid(transform: ArrayLike) -> Float64:
    """The inverse of (..., 4, 4) rigid transforms, without a general matrix inversion."""
    transform = np.asarray(transform, np.float64)
    rotation = np.swapaxes(transform[..., :3, :3], -1, -2)
    inverse = np.zeros_like(transform)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, transform[..., :3, 3])
    inverse[..., 3, 3] = 1
    return inverse


def rigid_poses(rotation: ArrayLike, translation: ArrayLike = (0, 0, 0)) -> Float64:
    """(..., 4, 4) float64 transforms of (..., 3, 3) rotations and (..., 3) translations."""
    turn = np.asarray(rotation, np.float64)
    poses = np.zeros((*turn.shape[:-2], 4, 4))
    poses[..., :3, :3], poses[..., :3, 3], poses[..., 3, 3] = turn, translation, 1
    return poses


def rigid_transform(matrix: ArrayLike, *, what: str) -> tuple[Float64, float]:
    """A rigid transform read from outside, with its rotation made exactly orthonormal.

    Args:
        matrix: (4, 4) or (3, 4).
        what: where it was read, for the message.

    Returns:
        The (4, 4) float64 transform with the nearest rotation, and the largest entry of
        ``R Rᵀ − I`` that was removed.
    """
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ShapeError(f"{what}: a pose of shape {matrix.shape}; expected 4x4 or 3x4")
    if not np.isfinite(matrix).all():
        raise ShapeError(f"{what}: the pose holds NaN or infinity; mend it or drop the view")
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        advice = "" if matrix[:3, 3].any() else "; transpose it, it is written column by column"
        last = f"{matrix[3].tolist()}; expected 0 0 0 1{advice}"
        raise ShapeError(f"{what}: the pose's last row is {last}")
    rotation = matrix[:3, :3]
    defect = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if defect > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        scale = float(np.cbrt(abs(np.linalg.det(rotation))))
        raise ShapeError(
            f"{what}: the pose's 3x3 part is no rotation (scale {scale:.6g}, determinant "
            f"{np.linalg.det(rotation):.6g}, defect {defect:.3g}); expected R Rᵀ = I to "
            f"{ROTATION_TOLERANCE:g} and determinant 1; divide the scale out or export again"
        )
    u, _, vt = np.linalg.svd(rotation)
    return rigid_poses(u @ vt, matrix[:3, 3]), defect
