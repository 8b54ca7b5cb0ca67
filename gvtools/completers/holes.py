"""How large the holes of a projection are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def hole_reach(valid: NDArray[np.bool_]) -> float:
    """How far the pixel farthest from what is known lies from it, as a share of the diagonal.

    Args:
        valid: (H, W) bool, where something is known.

    Returns:
        0 without holes, infinity where nothing is known.
    """
    if valid.all():
        return 0.0
    if not valid.any():
        return float("inf")
    import cv2

    distance = cv2.distanceTransform((~valid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float(distance.max()) / float(np.hypot(*valid.shape))
