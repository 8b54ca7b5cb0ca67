"""A look at a whole cloud that nobody is known to have seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, invert_rigid
from gvtools.trajectories import look_at

if TYPE_CHECKING:
    from viz.run_view.view import RunView

# Vertical field of view, radians.
FIELD_OF_VIEW = np.radians(75.0)
# How far above the horizon it looks from, radians, and how much room there is around the cloud.
ABOVE, ROOM = np.radians(30.0), 1.1


def position_outside(run: RunView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where to look from and at, (3,) each, world frame: the cloud is in view, its up is upwards.

    Args:
        run: of any memory with points.
    """
    up = run.up()
    low, high = run.bounds
    middle = (low + high) / 2
    radius = float(np.linalg.norm(high - low)) / 2 or run.typical_depth
    # Level and along the axis in which the cloud reaches least, so that its broad side is in view.
    reach = high - low
    reach[np.argmax(np.abs(up))] = np.inf
    ahead = np.eye(3)[np.argmin(reach)]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    away = ROOM * radius / np.sin(FIELD_OF_VIEW / 2)
    return middle + away * (np.sin(ABOVE) * up - np.cos(ABOVE) * ahead), middle


def camera_outside(run: RunView, *, width: int = 1280, height: int = 960) -> Cameras:
    """A camera there, a batch of one.

    Args:
        run: of any memory with points.
        width: pixels.
        height: pixels.
    """
    position, middle = position_outside(run)
    focal = height / 2 / np.tan(FIELD_OF_VIEW / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pose = invert_rigid(look_at(position[None], middle, up=run.up())[0])
    return Cameras(K[None], pose[None], np.array([width]), np.array([height]), ("outside",))
