"""Exposures of cameras from those of the photographs near them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gvtools.poses.motions import mean_near

# A camera's exposure is predicted from the COUNT photographs nearest to it, weighted by
# exp(-(distance / (SHIFT typical depths) + angle between viewing directions [rad] / TURN)).
COUNT, SHIFT, TURN = 4, 0.2, 0.3


@dataclass(frozen=True, eq=False)
class Exposures:
    """Exposures of photographs, from which that of a camera near them is predicted.

    Cameras on automatic expose for what they see, so photographs near each other have similar
    exposures. How far that holds in a scene is found by predicting each photograph's exposure from
    the others'.

    Attributes:
        poses: (V, 4, 4) cam_from_local, in the Gaussians' own frame.
        log_gains: (V, 3) natural logarithms of the factors of red, green and blue, with mean zero.
        depth: typical depth, scene units.

    >>> poses = np.tile(np.eye(4), (9, 1, 1))
    >>> poses[:, 0, 3] = places = np.linspace(0, 1, 9)
    >>> rising = Exposures(poses, np.outer(places - 0.5, [0.2, 0.2, 0.2]), depth=1.0)
    >>> dark, bright = rising.at(poses[0]), rising.at(poses[8])
    >>> bool(dark[0] < 1 < bright[0])
    True
    """

    poses: NDArray[np.float64]
    log_gains: NDArray[np.float64]
    depth: float

    @cached_property
    def shrinkage(self) -> float:
        """Regression slope of the log gains on those predicted from the other photographs, 0 to 1.

        At 0 neighbours predict nothing, and new cameras get the mean exposure of all photographs.
        """
        if len(self.poses) < 2:
            return 0.0
        near = np.array([self._near(pose, but=row) for row, pose in enumerate(self.poses)])
        squares = float(np.square(near).sum())
        if not squares > 0:
            return 0.0
        return float(np.clip((near * self.log_gains).sum() / squares, 0, 1))

    def at(self, pose: NDArray[np.float64]) -> NDArray[np.float32]:
        """(3,) factors of red, green and blue for a camera at ``pose``, cam_from_local (4, 4)."""
        if self.shrinkage == 0:
            return np.ones(3, np.float32)
        return np.exp(self.shrinkage * self._near(pose)).astype(np.float32)

    def _near(self, pose: NDArray[np.float64], *, but: int | None = None) -> NDArray[np.float64]:
        return mean_near(
            pose, self.poses, self.log_gains, depth=self.depth,
            but=() if but is None else (but,), count=COUNT, reach=(SHIFT, TURN),
        )  # fmt: skip
