"""Gaussians turned into other axes: positions, rotations and spherical harmonics alike.

Harmonics of one degree turn into harmonics of the same degree. The matrix that does it follows from
what both say of a few directions: nine coefficients, and more directions than that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from gvtools.appearance.splat.project_kernels import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    POSITION,
    QUATERNION,
    SH,
    _harmonics,
)

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


def harmonics_turned(axes: ArrayLike) -> NDArray[np.float64]:
    """(9, 9) matrix M: coefficients c in a frame are M c in one where its axes are ``axes``.

    Args:
        axes: (3, 3) rotation; its columns are the axes of the frame that c is given in.

    >>> halfway = harmonics_turned(np.diag([1.0, -1.0, -1.0]))  # half a turn around x
    >>> np.diag(halfway).round().astype(int).tolist()
    [1, -1, -1, 1, -1, 1, 1, -1, 1]
    """
    drawn = np.random.default_rng(SEED).normal(size=(DIRECTIONS, 3))
    outer = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    inner = outer @ np.asarray(axes, np.float64)
    turned = np.linalg.lstsq(harmonics(outer), harmonics(inner), rcond=None)[0]
    return np.asarray(turned, np.float64)


def turned(values: NDArray[np.float32], axes: NDArray[np.float64]) -> NDArray[np.float32]:
    """Parameters of Gaussians in another frame, whose origin is the same.

    Args:
        values: (N, VALUES), see splat.project_kernels; not changed.
        axes: (3, 3) rotation; its columns are the axes of the present frame in the other one.
    """
    out = values.copy()
    out[:, POSITION:LOG_SCALE] = values[:, POSITION:LOG_SCALE].astype(np.float64) @ axes.T
    w, x, y, z = values[:, QUATERNION:LOGIT].astype(np.float64).T
    rotation = Rotation.from_matrix(axes) * Rotation.from_quat(np.stack([x, y, z, w], axis=1))
    out[:, QUATERNION:LOGIT] = np.roll(rotation.as_quat(), 1, axis=1)
    sh = values[:, SH:].reshape(len(values), -1, 3)
    out[:, SH:] = np.einsum("ij,njc->nic", harmonics_turned(axes), sh).reshape(len(values), -1)
    return out
