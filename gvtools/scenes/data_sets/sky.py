"""Where up is in pictures that are stored as the sensor lay."""

from __future__ import annotations

import numpy as np

from gvtools.scenes.data_sets.posed_pictures import Float64
from gvtools.scenes.scene import Finding

UP = {"up": (0, -1), "left": (-1, 0), "down": (0, 1), "right": (1, 0)}  # x, y in the picture


def sky_findings(cam_from_world: Float64, axis: int) -> list[Finding]:
    """A line when the sky is not to the top of most pictures.

    Args:
        cam_from_world: (N, 4, 4), OpenCV axes.
        axis: the number of the world's axis that points up.
    """
    up = cam_from_world[:, :2, axis].mean(axis=0)
    sky = max(UP, key=lambda name: float(up @ np.array(UP[name])))
    if sky == "up":
        return []
    line = f"the sky is to the {sky} of pictures: they are read as stored, not turned"
    return [Finding("info", line)]
