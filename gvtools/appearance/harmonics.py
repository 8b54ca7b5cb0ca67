"""Exposures of photographs in the harmonics of Gaussians.

A run's Gaussians have the colours of a mean exposure, and each camera its own exposure beside them.
Photographs near each other are exposed alike, so most of it depends on the direction that a
Gaussian is seen from, and that is what spherical harmonics can hold.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.gaussians import Gaussians
from gvtools.cameras import Cameras
from gvtools.splats import LOG_SCALE, SH, harmonics

# Weight of a change of coefficients of 1 beside errors of 1 in one camera. On `fox_colmap` 0.1
# loses 0.2 dB to pictures with each camera's exposure, 1 loses 0.3 dB, no change 1.4 dB.
RIDGE = 0.1


def expose(gaussians: Gaussians, exposures: Exposures, cameras: Cameras) -> Gaussians:
    """Gaussians whose colours are, in cameras that see them, as these cameras are exposed.

    Each Gaussian's harmonics change by the least squares solution over the ``cameras``, such as the
    photographs', whose picture its centre lies in. ``exposures`` are in the Gaussians' frame.
    """
    values = gaussians.values
    sh = values[:, SH:].reshape(len(values), -1, 3).astype(np.float64)
    terms = sh.shape[1]
    normal = np.tile(RIDGE * np.eye(terms), (len(values), 1, 1))
    right = np.zeros_like(sh)
    for camera in cameras:
        pose = gaussians.frame.cam_from_local(camera.cam_from_world)[0]
        seen, directions = _seen(values[:, :LOG_SCALE].astype(np.float64), camera, pose)
        basis = harmonics(directions, 2)
        colors = np.maximum(0.5 + np.einsum("nh,nhc->nc", basis, sh[seen]), 0)
        change = (exposures.at(pose) - 1) * colors
        normal[seen] += basis[:, :, None] * basis[:, None]
        right[seen] += basis[:, :, None] * change[:, None]
    out = values.copy()
    out[:, SH:] = (sh + np.linalg.solve(normal, right)).reshape(len(values), -1)
    return Gaussians(out, frame=gaussians.frame)


def _seen(
    positions: NDArray[np.float64], camera: Cameras, pose: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of ``positions`` (N, 3) in a camera's picture, and directions (M, 3) to them."""
    points = positions @ pose[:3, :3].T + pose[:3, 3]
    ahead = points[:, 2] > 0
    x, y, w = (points @ camera.K[0].T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.stack([x / w, y / w], axis=1)
    size = np.array([camera.width[0], camera.height[0]])
    seen = np.flatnonzero(ahead & ((xy > 0) & (xy < size)).all(axis=1))
    away = points[seen] @ pose[:3, :3]
    return seen, away / np.linalg.norm(away, axis=1, keepdims=True)
