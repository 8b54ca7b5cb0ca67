"""How large the holes of a projection are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rim_distance(known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(H, W) distance of each pixel to the nearest known one, pixels; infinite without any.

    Args:
        known: (H, W) bool.
    """
    import cv2

    if not known.any():
        return np.full(known.shape, np.inf, np.float32)
    holes = (~known).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(holes, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def hole_reach(valid: NDArray[np.bool_]) -> float:
    """How far the pixel farthest from what is known lies from it, as a share of the diagonal.

    Args:
        valid: (H, W) bool, where something is known.

    Returns:
        0 without holes, infinity where nothing is known.
    """
    return float(rim_distance(valid).max()) / float(np.hypot(*valid.shape))
