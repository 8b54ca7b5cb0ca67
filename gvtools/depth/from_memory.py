"""Depth of a photograph taken from the memory, where the memory's projection matches it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.depth.source import DepthMap
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions

# Colours that differ by less, in the mean over a window, may be of one surface: pictures have
# noise, edges are half a pixel off, and surfaces shine. In a picture darker than BRIGHT it is less.
SAME_COLOR, BRIGHT, WINDOW = 0.2, 0.5, 5
# A photograph this many times brighter or darker than memory tells too little.
MOST_GAIN = 4.0
# What such depth names as its source.
MEMORY = "memory"


def depth_from_memory(
    memory: SpatialMemory,
    camera: Cameras,
    rgb: NDArray[np.uint8],
    *,
    least: float,
    options: SplatOptions | None = None,
) -> DepthMap | None:
    """The memory's projected depth of a photograph, if the projection matches enough of it.

    A pixel matches where the memory's observed content shows the photograph's colour, but for a
    gain per channel that all pixels share; the darker the photograph, the less may be off.

    Args:
        camera: of the photograph, a batch of one.
        rgb: (H, W, 3) uint8, the photograph.
        least: the share of the pixels that have to match.

    Returns:
        Depth and confidence of the matching pixels, source MEMORY; None where they are too few.
    """
    if not len(memory):
        return None
    known = memory.project(camera, options=options)
    valid = known.valid[0] & ~known.generated[0]
    if valid.mean() < least or not valid.any():
        return None
    seen = (rgb / np.float32(255)).astype(np.float32)
    shown = known.rgb[0]
    level = np.median(seen[valid], axis=0)
    gain = level / np.maximum(np.median(shown[valid], axis=0), 1 / 255)
    if gain.max() > MOST_GAIN or gain.min() < 1 / MOST_GAIN:
        return None
    tolerance = SAME_COLOR * min(1.0, float(level.mean()) / BRIGHT)
    off = np.abs(shown * gain.astype(np.float32) - seen).mean(-1) * valid
    size = (WINDOW, WINDOW)
    mean = cv2.blur(off, size) / np.maximum(cv2.blur(valid.astype(np.float32), size), 1e-6)
    matching = valid & (mean < tolerance)
    if matching.mean() < least:
        return None
    depth = np.where(matching, known.depth[0], np.float32(0))
    confidence = np.where(matching, np.minimum(known.confidence[0], 1), np.float32(1))
    return DepthMap(depth, confidence.astype(np.float32), MEMORY)
