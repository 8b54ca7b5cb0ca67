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


def hole_radius(valid: NDArray[np.bool_]) -> float:
    """Largest distance of a hole's pixel to a valid one, as a share of the image diagonal.

    Args:
        valid: (H, W) bool, where something is known.

    Returns:
        0 without holes, infinity where nothing is known.
    """
    return float(rim_distance(valid).max()) / float(np.hypot(*valid.shape))
