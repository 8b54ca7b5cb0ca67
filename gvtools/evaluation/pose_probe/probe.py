"""The pose probe: match a picture with the context, and solve for where it looks from.

The claim under test, the picture's requested pose, is used for nothing but the errors at the end:
the context views to match are chosen by the picture's own features.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gvtools.cameras import Cameras, Float64, concatenate
from gvtools.errors import DegenerateError, OptionError
from gvtools.evaluation.pose_probe.absolute_pose import (
    AbsolutePose,
    absolute_pose,
    angle_deg,
    center_distance,
    rival_pose,
)
from gvtools.evaluation.pose_probe.lifting import lift_keypoints
from gvtools.evaluation.pose_probe.located import LOCATED, Located
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.features import (
    FeatureMatcher,
    Features,
    SiftMatcher,
    mutual_nearest,
)
from gvtools.settings import Settings

# Cells along the longer side of a picture, in which the spread of the inliers is counted.
CELLS = 16


class PoseProbeOptions(Settings):
    """How a picture is located, and when it counts as located.

    The thresholds on inliers and cells were set on a real room of 5 to 50 context views at 640x480.
    Photographs of other places, noise and negatives reach 7 inliers in 5 cells; mirrored
    photographs of the room, where things are symmetric, 20; photographs cut into 8x8 pieces and
    shuffled, 66 in 8 cells, which are those of one piece. Held-out photographs have 51 and more, in
    27 cells and more. COLMAP's mapper asks for 30.
    """

    section = "pose_probe"

    views: int = Field(10, ge=1)
    """Context views to match; all are when there are no more."""
    prominent: int = Field(500, ge=1)
    """Keypoints of a picture by which those views are chosen."""
    edge: float = Field(0.05, gt=0)
    """A keypoint is lifted where the depths around it spread over less than this share."""
    max_error: float | None = Field(None, gt=0)
    """Reprojection error of an inlier; none means 1/160 of the picture's longer side (4 pixels at
    640, 12 at 1920), at least 2. [px]"""
    min_inliers: int = Field(25, ge=4)
    """Fewer do not locate a picture."""
    min_cells: int = Field(10, ge=1)
    """Nor do inliers in fewer cells of the picture; its longer side has 16."""
    max_rival: float = Field(0.5, gt=0, le=1)
    """Nor does a pose while another, which contradicts it, has this share of its inliers."""


@dataclass(frozen=True, eq=False)
class _ContextView:
    """A context view's keypoints that have a 3D point: features (N), points (N, 3)."""

    name: str
    features: Features
    points: Float64


@dataclass(frozen=True)
class _Counts:
    """Of one picture, as in ``Located``."""

    keypoints: int
    matches: int
    inliers: int
    cells: int
    rival: int


class PoseProbe:
    """Locates pictures against posed context views with depth.

    Attributes:
        options: see PoseProbeOptions.
        extent: twice the largest distance of a context centre from their mean, scene units.

    Args:
        context: views with depth from any source (measured, or the memory's projection); those
            without depth give no points.
        matcher: finds and matches keypoints.
        options: see PoseProbeOptions.
        seed: of the robust estimate; the same seed gives the same answer.
    """

    def __init__(
        self,
        context: Sequence[PosedPicture],
        *,
        matcher: FeatureMatcher | None = None,
        options: PoseProbeOptions | None = None,
        seed: int = 0,
    ) -> None:
        self.options = options or PoseProbeOptions()
        self.seed = seed
        self._matcher = matcher or SiftMatcher()
        self._context = tuple(context)
        if len({picture.name for picture in self._context}) != len(self._context):
            raise OptionError("pose probe: two context views have one name; names must differ")
        self._views = [self._lifted(picture) for picture in self._context]
        if not any(len(view.points) for view in self._views):
            raise DegenerateError(
                f"pose probe: none of {len(self._context)} context views has keypoints with depth; "
                "give views with texture and depth"
            )
        self.extent = _extent([picture.camera for picture in self._context])

    def locate(self, picture: PosedPicture, *, leave_out: Collection[str] = ()) -> Located:
        """Where ``picture`` looks from, by its pixels alone.

        Args:
            picture: its mask limits the keypoints; its camera's pose is only compared with.
            leave_out: names of context views not to match; other names mean nothing.
        """
        features = self._matcher.extract(picture.rgb)
        features = features[_inside(features.xy, picture.mask)]
        views = self._promising(features, leave_out)
        keypoint, points = self._correspondences(features, views)
        pose, counts = self._solved(features, keypoint, points, K=picture.camera.K[0])
        reason = self._reason(counts)
        return self._located(
            picture,
            None if reason else pose,
            status=f"failed: {reason}" if reason else LOCATED,
            counts=counts,
            views=tuple(view.name for view in views),
        )

    def leave_one_out(self, count: int | None = None) -> list[Located]:
        """Context views located by the others: the error that the probe has on real pictures.

        What a generated picture is off by means little below it.

        Args:
            count: how many, evenly spread over the context; None takes all.
        """
        total = len(self._context)
        chosen = np.unique(np.linspace(0, total - 1, min(count or total, total)).round())
        pictures = [self._context[int(i)] for i in chosen]
        return [self.locate(picture, leave_out=(picture.name,)) for picture in pictures]

    def _lifted(self, picture: PosedPicture) -> _ContextView:
        features = self._matcher.extract(picture.rgb)
        features = features[_inside(features.xy, picture.mask)]
        if picture.depth is None:
            return _ContextView(picture.name, features[:0], np.zeros((0, 3)))
        edge = self.options.edge
        points, ok = lift_keypoints(features.xy, picture.depth, picture.camera, edge=edge)
        return _ContextView(picture.name, features[ok], points[ok])

    def _promising(self, features: Features, leave_out: Collection[str]) -> list[_ContextView]:
        """The views whose most prominent keypoints match those of the picture most often."""
        views = [view for view in self._views if view.name not in leave_out and len(view.points)]
        if len(views) <= self.options.views:
            return views
        most = self.options.prominent
        votes = [
            len(mutual_nearest(features.descriptors[:most], view.features.descriptors[:most]))
            for view in views
        ]
        order = np.argsort(-np.asarray(votes), kind="stable")[: self.options.views]
        return [views[i] for i in order]

    def _correspondences(
        self, features: Features, views: Sequence[_ContextView]
    ) -> tuple[NDArray[np.int64], Float64]:
        """Keypoint numbers (M,) and their 3D partners (M, 3), over all views."""
        keypoints, points = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
        for view in views:
            pairs = self._matcher.match(features, view.features)
            keypoints.append(pairs[:, 0])
            points.append(view.points[pairs[:, 1]])
        return np.concatenate(keypoints), np.concatenate(points)

    def _solved(
        self, features: Features, keypoint: NDArray[np.int64], points: Float64, *, K: Float64
    ) -> tuple[AbsolutePose | None, _Counts]:
        """The best pose, and what speaks for and against it."""
        xy = features.xy[keypoint]
        # A keypoint may have several orientations: places are counted, not keypoints.
        places, place = np.unique(xy, axis=0, return_inverse=True)
        place = place.reshape(-1)
        size = {"width": features.width, "height": features.height}
        error = self.options.max_error or max(2.0, max(size.values()) / 160)
        pose = absolute_pose(xy, points, K, max_error=error, seed=self.seed)
        if pose is None:
            return None, _Counts(len(features), len(places), 0, 0, 0)
        agreed = np.unique(place[pose.inliers])
        rival = rival_pose(
            xy,
            points,
            K,
            pose=pose,
            max_error=error,
            share=self.options.max_rival,
            seed=self.seed,
        )
        return pose, _Counts(
            keypoints=len(features),
            matches=len(places),
            inliers=len(agreed),
            cells=_cells(places[agreed], **size),
            rival=0 if rival is None else len(np.unique(place[rival.inliers])),
        )

    def _reason(self, counts: _Counts) -> str:
        """Why a picture does not count as located; empty when it does."""
        options = self.options
        if counts.matches < options.min_inliers:
            return (
                f"{counts.matches} matches of {counts.keypoints} keypoints, at least "
                f"{options.min_inliers} are needed"
            )
        if counts.inliers < options.min_inliers:
            return (
                f"{counts.inliers} inliers of {counts.matches} matches, at least "
                f"{options.min_inliers} are needed"
            )
        if counts.cells < options.min_cells:
            return (
                f"{counts.inliers} inliers in {counts.cells} cells of the picture, at least "
                f"{options.min_cells} are needed"
            )
        if counts.rival >= options.max_rival * counts.inliers:
            return (
                f"ambiguous, {counts.inliers} matches agree on one pose and {counts.rival} on "
                "another that contradicts it"
            )
        return ""

    def _located(
        self,
        picture: PosedPicture,
        pose: AbsolutePose | None,
        *,
        status: str,
        counts: _Counts,
        views: tuple[str, ...],
    ) -> Located:
        requested = picture.camera.cam_from_world[0]
        found = None if pose is None else pose.cam_from_world
        distance = None if found is None else center_distance(found, requested)
        angle = None if found is None else angle_deg(found[:3, :3], requested[:3, :3])
        return Located(
            name=picture.name,
            status=status,
            cam_from_world=found,
            residual=None if pose is None else pose.rms,
            views=views,
            rotation_error_deg=angle,
            center_error=distance,
            center_error_share=None if distance is None else _share(distance, self.extent),
            **asdict(counts),
        )


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole > 0 else None


def _inside(xy: Float64, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """(N,) bool: whether the pixel that a keypoint lies in is to be used."""
    if mask is None:
        return np.ones(len(xy), np.bool_)
    height, width = mask.shape
    x, y = np.clip(np.floor(xy).astype(np.int64), 0, [width - 1, height - 1]).T
    return mask[y, x]


def _cells(xy: Float64, *, width: int, height: int) -> int:
    """How many cells of the picture hold one of the places."""
    return len(np.unique(np.floor(xy / (max(width, height) / CELLS)), axis=0))


def _extent(cameras: Sequence[Cameras]) -> float:
    centers = concatenate(cameras).centers
    return float(2 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
