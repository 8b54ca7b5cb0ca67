"""What the pose probe found of a picture, and what that sums up to: never errors alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gvtools.cameras import Float64
from gvtools.evaluation.trajectories import AUC_THRESHOLDS, Statistics, area_under_recall

LOCATED = "located"


@dataclass(frozen=True, eq=False)
class Located:
    """Where one picture looks from, and how far that is from where it was meant to.

    Attributes:
        name: the picture's.
        status: "located", or "failed: ..." with the reason; then pose and errors are None.
        cam_from_world: (4, 4) float64, rigid, scene units.
        keypoints: found in the picture (within its mask).
        matches: places in the picture that match a context keypoint with a 3D point. A place counts
            once, however many context views it matches.
        inliers: those that the best pose explains; reported of failed pictures as well.
        cells: how many of the picture's cells hold an inlier; a cell's side is 1/16 of the longer
            side of the picture.
        rival: places that agree on another pose, which contradicts the best one; 0 when no pose
            with a comparable number was met.
        residual: root mean square of the inliers' reprojection errors, pixels.
        views: names of the context views that were matched, the most promising first.
        rotation_error_deg: angle between the found and the requested orientation.
        center_error: distance of the found from the requested centre, scene units.
        center_error_share: that, divided by the extent of the context's centres; None also when
            the extent is 0.
    """

    name: str
    status: str
    cam_from_world: Float64 | None
    keypoints: int
    matches: int
    inliers: int
    cells: int
    rival: int
    residual: float | None
    views: tuple[str, ...]
    rotation_error_deg: float | None
    center_error: float | None
    center_error_share: float | None

    @property
    def ok(self) -> bool:
        """Whether the picture was located."""
        return self.status == LOCATED

    @property
    def inlier_share(self) -> float | None:
        """Inliers per match; None without matches."""
        return self.inliers / self.matches if self.matches else None


@dataclass(frozen=True)
class PoseSummary:
    """The probe's findings over a set of pictures.

    Statistics are over the located pictures alone and say how many those are; they flatter a set
    whose hard pictures fail, and are to be read beside ``success_share``. ``rotation_auc`` counts
    failures as wrong.

    Attributes:
        pictures: how many were probed.
        located: how many of them were located.
        success_share: located per picture; None without pictures.
        failures: name and status of every picture that was not.
        rotation_error_deg: over the located; None when there are none.
        center_error: likewise, scene units.
        center_error_share: likewise, divided by the extent of the context's centres.
        rotation_auc: by threshold in degrees, the area under the share of *all* pictures that are
            located with a rotation error below x, for x up to the threshold; None without pictures.
        inliers: over the located, places of a picture that agree with its pose.
        inlier_share: over the located, those per match.
    """

    pictures: int
    located: int
    success_share: float | None
    failures: tuple[tuple[str, str], ...]
    rotation_error_deg: Statistics | None
    center_error: Statistics | None
    center_error_share: Statistics | None
    rotation_auc: dict[float, float | None]
    inliers: Statistics | None
    inlier_share: Statistics | None


def summarise(found: Sequence[Located]) -> PoseSummary:
    """The findings of all probed pictures; leave none out, failures least of all."""
    ok = [one for one in found if one.ok]
    angles = [np.inf if one.rotation_error_deg is None else one.rotation_error_deg for one in found]
    return PoseSummary(
        pictures=len(found),
        located=len(ok),
        success_share=len(ok) / len(found) if found else None,
        failures=tuple((one.name, one.status) for one in found if not one.ok),
        rotation_error_deg=_statistics([one.rotation_error_deg for one in ok]),
        center_error=_statistics([one.center_error for one in ok]),
        center_error_share=_statistics([one.center_error_share for one in ok]),
        rotation_auc={
            threshold: area_under_recall(angles, threshold) if found else None
            for threshold in AUC_THRESHOLDS
        },
        inliers=_statistics([one.inliers for one in ok]),
        inlier_share=_statistics([one.inlier_share for one in ok]),
    )


def _statistics(values: Sequence[float | None]) -> Statistics | None:
    return Statistics.of([value for value in values if value is not None])
