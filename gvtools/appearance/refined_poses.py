"""Refined poses: whether they are better than the given ones, and how other cameras follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.camera_corrections import LEAST_BETTER, mean_near, motions_between, moved
from gvtools.appearance.fit_views import FitView
from gvtools.appearance.pose_check import compared, prediction_error
from gvtools.appearance.pose_graph import agreeing_poses


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """Poses on which views agree, beside those that they were given.

    Attributes:
        given: (V, 4, 4) camera from world.
        poses: (V, 4, 4) refined.
        depth: typical depth, scene units.
        spread: whether other cameras err like the views near them.
        errors: by given and by refined poses: mean difference of colours between neighbouring
            views where they show the same, 0 to 1, or what features miss, pixels.
        by_features: whether these told the poses, to a fraction of a pixel: a fit leaves them.
        in_pixels: the unit of ``errors``.
    """

    given: NDArray[np.float64]
    poses: NDArray[np.float64]
    depth: float
    spread: bool
    errors: tuple[float, float]
    by_features: bool = False
    in_pixels: bool = False

    @property
    def motions(self) -> NDArray[np.float64]:
        """(V, 6) shift and turn from the given pose to the refined one, on the camera's side."""
        return motions_between(self.given, self.poses)

    def corrected(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """(4, 4) another camera's pose, moved as the views near it were if ``spread``."""
        if not self.spread:
            return pose
        return moved(pose, mean_near(pose, self.given, self.motions, depth=self.depth))

    def __str__(self) -> str:
        shift = np.median(np.linalg.norm(self.motions[:, :3], axis=1))
        turn = np.degrees(np.median(np.linalg.norm(self.motions[:, 3:], axis=1)))
        before, after = self.errors
        told = f"neighbouring views differ by {after:.4f} instead of {before:.4f}"
        if self.in_pixels:
            told = f"features miss them by {after:.2f} instead of {before:.2f} px"
        return f"moved by {shift:.3g} scene units and {turn:.2f} degrees (medians); {told}" + (
            "; targets moved like the context near them" if self.spread else ""
        )


def refined_poses(
    views: Sequence[FitView], poses: NDArray[np.float64] | None = None
) -> RefinedPoses | None:
    """Poses on which neighbouring views agree; None where the given ones are as good.

    Args:
        views: all with depth, neighbours along the path beside each other.
        poses: (V, 4, 4) told by features; None finds some by odometry.
    """
    if len(views) < 2:
        return None
    given = np.stack([view.cam_from_local for view in views])
    by_features = poses is not None
    if poses is None:
        poses = agreeing_poses(views)
    small = compared(views)
    before, after = prediction_error(small, given), prediction_error(small, poses)
    if not after < before * (1 - LEAST_BETTER):
        return None
    depth = np.concatenate([view.depth[::8, ::8].ravel() for view in views])  # type: ignore[index]
    typical = float(np.median(depth[depth > 0]))
    found = RefinedPoses(given, poses, typical, False, (before, after), by_features)
    # Each view is once treated as another camera: does it look more like its refined neighbours
    # where it was given, or moved as they were?
    motions = found.motions
    alike = [
        moved(pose, mean_near(pose, given, motions, depth=typical, but=[row]))
        for row, pose in enumerate(given)
    ]
    near = prediction_error(small, poses, at=np.stack(alike))
    away = prediction_error(small, poses, at=given)
    spread = near < away * (1 - LEAST_BETTER)
    return replace(found, spread=spread)
