"""Gaussians and meshes as viewers show them: without harmonics, in the world's axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.exposed import seen_by
from gvtools.appearance.splat.project_kernels import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    QUATERNION,
    SH,
)
from gvtools.appearance.turning import harmonics
from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame

# Of the cameras that tell a Gaussian's colour.
MOST_CAMERAS = 64
# A Gaussian's least standard deviation in shares of its largest: viewers keep covariances in
# half precision, in which thinner ones would not stay positive definite.
THINNEST = 1 / 32


@dataclass(frozen=True, eq=False)
class ShownGaussians:
    """N Gaussians with the world's axes.

    Attributes:
        values: (N, VALUES) float32, see appearance.splat.project_kernels; positions count from
            ``origin``.
        origin: (3,) float64, world frame, scene units.
        rounds: (N,) int32, the round that each came with.
    """

    values: NDArray[np.float32]
    origin: NDArray[np.float64]
    rounds: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.values)

    @property
    def centers(self) -> NDArray[np.float64]:
        """(N, 3) in the world frame, scene units."""
        return self.values[:, :LOG_SCALE].astype(np.float64) + self.origin

    @property
    def opacities(self) -> NDArray[np.float32]:
        """(N, 1) from 0 to 1."""
        logits = np.clip(self.values[:, LOGIT : LOGIT + 1], -30, 30)
        return np.asarray(1 / (1 + np.exp(-logits)), np.float32)

    def covariances(self, scale: float, *, largest: float) -> NDArray[np.float32]:
        """(N, 3, 3) in units of which a scene unit has ``scale``.

        Args:
            scale: of the page.
            largest: standard deviations are at most this, in its units.
        """
        from scipy.spatial.transform import Rotation

        w, x, y, z = self.values[:, QUATERNION:LOGIT].astype(np.float64).T
        axes = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
        log_sizes = self.values[:, LOG_SCALE:QUATERNION].astype(np.float64) + np.log(scale)
        sizes = np.exp(np.minimum(log_sizes, np.log(largest)))
        sizes = np.maximum(sizes, THINNEST * sizes.max(axis=1, keepdims=True))
        half = axes * sizes[:, None]
        return np.asarray(half @ half.transpose(0, 2, 1), np.float32)

    def colors(self, cameras: Cameras | None) -> NDArray[np.uint8]:
        """(N, 3) uint8: the mean of what the cameras that have a Gaussian in their picture see.

        Where none has it, or no cameras are given, the mean over all directions.
        """
        sh = self.values[:, SH:].reshape(len(self), -1, 3).astype(np.float64)
        shown = np.maximum(0.5 + HARMONICS[0] * sh[:, 0], 0)
        if cameras is not None and sh[:, 1:].any():
            sums, counts = np.zeros_like(shown), np.zeros(len(self))
            frame = LocalFrame.at(self.origin)
            positions = self.values[:, :LOG_SCALE].astype(np.float64)
            for camera in cameras[:: -(-len(cameras) // MOST_CAMERAS)]:
                pose = frame.cam_from_local(camera.cam_from_world)[0]
                rows, directions = seen_by(positions, camera, pose)
                there = np.einsum("nh,nhc->nc", harmonics(directions), sh[rows])
                sums[rows] += np.maximum(0.5 + there, 0)
                counts[rows] += 1
            seen = counts > 0
            shown[seen] = sums[seen] / counts[seen, None]
        return np.rint(255 * np.minimum(shown, 1)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh.

    Attributes:
        vertices: (V, 3) float64, world frame, scene units.
        faces: (F, 3) int, rows of ``vertices``.
        colors: (V, 3) uint8.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    colors: NDArray[np.uint8]
