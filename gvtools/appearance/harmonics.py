"""Spherical harmonics of Gaussians: in other axes, and with the exposures of photographs.

Harmonics of one degree turn into harmonics of the same degree. The matrix that does it follows from
what both say of a few directions: nine coefficients, and more directions than that.

A run's Gaussians have the colours of a mean exposure, and each camera its own exposure beside them.
Photographs near each other are exposed alike, so most of it depends on the direction that a
Gaussian is seen from, and that is what spherical harmonics can hold.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    POSITION,
    QUATERNION,
    SH,
    _harmonics,
)
from gvtools.cameras import Cameras

# Directions that the harmonics are compared in, and the seed that draws them.
DIRECTIONS, SEED = 64, 0


def harmonics(directions: ArrayLike) -> NDArray[np.float64]:
    """The spherical harmonics of degree 0 to 2, (N, 9), of unit directions (N, 3).

    >>> harmonics([[0, 0, 1]])[0, :3].round(3)
    array([ 0.282, -0.   ,  0.489])
    """
    x, y, z = np.asarray(directions, np.float64).T
    function = getattr(_harmonics, "py_func", _harmonics)
    return np.stack(np.broadcast_arrays(*function(HARMONICS, x, y, z)), axis=1)


def turn_harmonics(axes: ArrayLike) -> NDArray[np.float64]:
    """(9, 9) matrix M: coefficients c in a frame are M c in one where its axes are ``axes`` (3, 3).

    >>> halfway = turn_harmonics(np.diag([1.0, -1.0, -1.0]))  # half a turn around x
    >>> np.diag(halfway).round().astype(int).tolist()
    [1, -1, -1, 1, -1, 1, 1, -1, 1]
    """
    drawn = np.random.default_rng(SEED).normal(size=(DIRECTIONS, 3))
    outer = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    inner = outer @ np.asarray(axes, np.float64)
    turned = np.linalg.lstsq(harmonics(outer), harmonics(inner), rcond=None)[0]
    return np.asarray(turned, np.float64)


def turn_gaussians(values: NDArray[np.float32], axes: NDArray[np.float64]) -> NDArray[np.float32]:
    """Gaussians (N, VALUES) in another frame of the same origin, where the axes are ``axes``."""
    out = values.copy()
    out[:, POSITION:LOG_SCALE] = values[:, POSITION:LOG_SCALE].astype(np.float64) @ axes.T
    w, x, y, z = values[:, QUATERNION:LOGIT].astype(np.float64).T
    rotation = Rotation.from_matrix(axes) * Rotation.from_quat(np.stack([x, y, z, w], axis=1))
    out[:, QUATERNION:LOGIT] = np.roll(rotation.as_quat(), 1, axis=1)
    sh = values[:, SH:].reshape(len(values), -1, 3)
    out[:, SH:] = np.einsum("ij,njc->nic", turn_harmonics(axes), sh).reshape(len(values), -1)
    return out


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
        basis = harmonics(directions)
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
