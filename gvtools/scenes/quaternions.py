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
    x, y, z, w = quaternion
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z],
        ]
    )
