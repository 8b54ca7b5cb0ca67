"""Rotations from quaternions as files give them: of any length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def rotation_from_quaternion(quaternion: Float64) -> Float64:
    """The rotation of a quaternion, times its squared length.

    A quaternion that is not of unit length so gives a scaled rotation, which the check of poses
    either mends exactly or refuses; formulas for unit quaternions would shear it instead.

    Args:
        quaternion: (4,) x, y, z, w.

    Returns:
        (3, 3) float64.
    """
    from scipy.spatial.transform import Rotation

    square = float(quaternion @ quaternion)
    if not 0 < square < np.inf:
        return np.full((3, 3), square)
    return np.asarray(square * Rotation.from_quat(quaternion).as_matrix())
