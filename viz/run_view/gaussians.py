"""Gaussians and meshes as viewers show them: without harmonics, in the world's axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.project_kernels import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    QUATERNION,
    SH,
)

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

    @property
    def colors(self) -> NDArray[np.uint8]:
        """(N, 3) uint8: the mean over all directions."""
        shown = 0.5 + HARMONICS[0] * self.values[:, SH : SH + 3]
        return np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8)


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
