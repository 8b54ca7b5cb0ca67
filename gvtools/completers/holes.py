"""How large the holes of a projection are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rim_distance(known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(H, W) distance of each pixel to the nearest known one, pixels; infinite without any.

    Args:
        known: (H, W) bool.
    """
    from scipy.ndimage import distance_transform_edt

    if not known.any():
        return np.full(known.shape, np.inf)
    # OpenCV is faster, and its last digit differs from call to call.
    return np.asarray(distance_transform_edt(~known), np.float64)


def hole_reach(valid: NDArray[np.bool_]) -> float:
    """How far the pixel farthest from what is known lies from it, as a share of the diagonal.

    Args:
        valid: (H, W) bool, where something is known.

    Returns:
        0 without holes, infinity where nothing is known.
    """
    return float(rim_distance(valid).max()) / float(np.hypot(*valid.shape))
