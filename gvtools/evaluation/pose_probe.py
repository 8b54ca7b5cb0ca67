"""The pose probe: match a picture with the context, and solve for where it looks from.

The claim under test, the picture's requested pose, is used for nothing but the errors at the end:
the context views to match are chosen by the picture's own features.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64, concatenate
from gvtools.errors import DegenerateError
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.evaluation.statistics import ErrorStatistics, share
from gvtools.evaluation.trajectories import AUC_THRESHOLDS, area_under_recall, center_extent
from gvtools.features import FeatureMatcher, Features, SiftMatcher, mutual_nearest
from gvtools.scenes.inspection import spread

LEAST = 4  # matches: three leave up to four poses
# Matches within this many times the error of a pose are near to it: their own pose is no rival.
NEAR = 3.0
# A pose contradicts another beyond this rotation, or this share of the depth of what it sees.
# Recorded poses of one real scene that do not quite agree give rivals up to 4 degrees and 9 % off.
ROTATION_DEG = 10.0
DEPTH_SHARE = 0.25
RIVALS = 3  # looked at: near ones may come first
# Cells along the longer side of a picture, in which the spread of the inliers is counted.
CELLS = 16
LOCATED = "located"
VIEWS = 10  # context views to match; all are when there are no more
PROMINENT = 500  # keypoints of a picture by which those views are chosen
EDGE = 0.05  # a keypoint is lifted where the depths around it spread over less than this share
# Fewer inliers, or inliers in fewer cells, do not locate a picture; nor does a pose while another,
# which contradicts it, has the share MAX_RIVAL of its inliers. They were set on a real room of 5 to
# 50 context views at 640x480. Photographs of other places, noise and negatives reach 7 inliers in 5
# cells; mirrored photographs of the room, where things are symmetric, 20; photographs cut into 8x8
# pieces and shuffled, 66 in 8 cells, which are those of one piece. Held-out photographs have 51 and
# more, in 27 cells and more. COLMAP's mapper asks for 30.
MIN_INLIERS, MIN_CELLS, MAX_RIVAL = 25, 10, 0.5


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """A pose, and the matches that support it."""

    cam_from_world: Float64  # (4, 4) float64, rigid, scene units
    inliers: NDArray[np.bool_]  # (M,) bool, matches within the error of this very pose
    rms: float  # root mean square of the inliers' reprojection errors, pixels


def absolute_pose(
    xy: Float64,
    points: Float64,
    K: Float64,
    *,
    max_error: float,
    seed: int = 0,
    min_inlier_share: float = 0.1,
) -> AbsolutePose | None:
    """Estimate by LO-RANSAC over P3P, refine over all inliers, and count those of the result.

    Matches are (M, 2) pixels, the first pixel's centre being (0.5, 0.5), and (M, 3) points in the
    world; an inlier's reprojection error is at most ``max_error`` pixels. Samples are drawn until a
    pose of the smallest share of inliers would have been met; below 0.1 there are at most 10,000.
    None when no four matches agree on a pose.
    """
    from gvtools.colmap import pycolmap

    if len(xy) < LEAST:
        return None
    # COLMAP's pinhole has no skew, and coordinates near 0 keep their digits.
    pinhole = np.column_stack([xy[:, 0] - K[0, 1] * (xy[:, 1] - K[1, 2]) / K[1, 1], xy[:, 1]])
    origin = points.mean(axis=0)
    # The picture's size plays no part.
    camera = pycolmap.Camera(
        model="PINHOLE", width=1, height=1, params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    )
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = max_error
    estimation.ransac.random_seed = seed
    estimation.ransac.min_inlier_ratio = min_inlier_share
    found = pycolmap.estimate_and_refine_absolute_pose(pinhole, points - origin, camera, estimation)
    if found is None:
        return None
    cam_from_world = np.eye(4)
    cam_from_world[:3] = found["cam_from_world"].matrix()
    errors = _reprojection_errors(cam_from_world, xy, points - origin, K=K)
    inliers = errors <= max_error
    if inliers.sum() < LEAST:
        return None
    cam_from_world[:3, 3] -= cam_from_world[:3, :3] @ origin
    return AbsolutePose(cam_from_world, inliers, float(np.sqrt(np.mean(errors[inliers] ** 2))))


def rival_pose(
    xy: Float64,
    points: Float64,
    K: Float64,
    *,
    pose: AbsolutePose,
    max_error: float,
    least_share: float,
    seed: int = 0,
) -> AbsolutePose | None:
    """The best pose that contradicts ``pose``, if about that share of its inliers support one.

    Repeated and symmetric things give such poses: a rug that looks the same from both ends, two
    chairs of one kind, pictures put together from pieces. Matches are as of ``absolute_pose``.
    """
    wanted = least_share * int(pose.inliers.sum())
    depth = float(np.median((points[pose.inliers] @ pose.cam_from_world[:3, :3].T)[:, 2]))
    depth += pose.cam_from_world[2, 3]
    known, rest = pose, np.ones(len(xy), np.bool_)
    for _ in range(RIVALS):
        rest &= _reprojection_errors(known.cam_from_world, xy, points, K=K) > NEAR * max_error
        if rest.sum() < max(wanted, LEAST):
            return None
        # Half of the wanted share: matches are counted here, not the places they come from.
        found = absolute_pose(
            xy[rest],
            points[rest],
            K,
            max_error=max_error,
            seed=seed,
            min_inlier_share=min(0.5 * wanted / int(rest.sum()), 0.9),
        )
        if found is None:
            return None
        inliers = np.zeros(len(xy), np.bool_)
        inliers[rest] = found.inliers
        known = AbsolutePose(found.cam_from_world, inliers, found.rms)
        turn = angle_deg(known.cam_from_world[:3, :3], pose.cam_from_world[:3, :3])
        distance = center_distance(known.cam_from_world, pose.cam_from_world)
        if turn > ROTATION_DEG or distance > DEPTH_SHARE * depth:
            return known
    return None


def angle_deg(first: Float64, second: Float64) -> float:
    """Angle between two (3, 3) orientations; |A − B| = 2 √2 sin(angle / 2), exact near 0."""
    chord = np.linalg.norm(first - second) / (2 * np.sqrt(2))
    return float(np.degrees(2 * np.arcsin(min(1.0, float(chord)))))


def center_distance(first: Float64, second: Float64) -> float:
    """Distance between the centres of two (4, 4) cam_from_world, scene units."""
    centers = [-pose[:3, :3].T @ pose[:3, 3] for pose in (first, second)]
    return float(np.linalg.norm(centers[0] - centers[1]))


def _reprojection_errors(pose: Float64, xy: Float64, points: Float64, *, K: Float64) -> Float64:
    """(M,) pixels; infinite behind the camera."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    ahead = local[:, 2] > 0
    z = np.where(ahead, local[:, 2], 1)
    projected = (local @ K.T)[:, :2] / z[:, None]
    return np.where(ahead, np.linalg.norm(projected - xy, axis=1), np.inf)


def lift_keypoints(
    xy: Float64, depth: NDArray[np.float32], camera: Cameras, *, edge: float
) -> tuple[Float64, NDArray[np.bool_]]:
    """(N, 3) world points of (N, 2) keypoints by the depth around each, and (N,) which hold.

    Depth (H, W; 0, NaN and inf mean none) is interpolated between the four nearest pixel centres as
    its inverse, which on a plane is linear in the picture. A keypoint needs all four depths, and
    they may not spread over more than the share ``edge``: across a silhouette the interpolated
    depth would lie on neither surface.
    """
    height, width = depth.shape
    corner = np.clip(np.floor(xy - 0.5), 0, np.maximum([width - 2, height - 2], 0)).astype(np.int64)
    # Outside the outermost centres the nearest depth holds.
    along = np.clip(xy - 0.5 - corner, 0, 1)
    x, y = corner.T
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.divide(1, depth, out=np.full(depth.shape, np.nan), where=known)
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    four = np.stack([inverse[y, x], inverse[y, right], inverse[below, x], inverse[below, right]])
    u, v = along.T
    weight = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    z = 1 / (four * weight).sum(axis=0)
    ok = (four.max(axis=0) - four.min(axis=0)) * z <= edge
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(camera.K[0]).T
    points = rays * z[:, None] @ camera.world_from_cam[0, :3, :3].T + camera.centers[0]
    return points, ok


@dataclass(frozen=True, kw_only=True)
class _Counts:
    """How many matches speak for a pose."""

    keypoints: int  # found in the picture (within its mask)
    # Places in the picture that match a context keypoint with a 3D point. A place counts once,
    # however many context views it matches.
    matches: int
    inliers: int = 0  # those that the best pose explains; reported of failed pictures as well
    # How many of the picture's cells hold an inlier; a cell's side is 1/16 of the longer side of
    # the picture.
    cells: int = 0
    # Places that agree on another pose, which contradicts the best one; 0 when no pose with a
    # comparable number was met.
    rival: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Located(_Counts):
    """Where one picture looks from, and how far that is from where it was meant to."""

    name: str  # the picture's
    status: str  # "located", or "failed: ..." with the reason; then pose and errors are None
    cam_from_world: Float64 | None = None  # (4, 4) float64, rigid, scene units
    residual: float | None = None  # root mean square of the inliers' reprojection errors, pixels
    views: tuple[str, ...]  # names of the context views that were matched, the most promising first
    rotation_error_deg: float | None = None  # between the estimated and the requested orientation
    center_error: float | None = None  # distance from the requested centre, scene units
    # That, divided by the extent of the context's centres; None also when the extent is 0.
    center_error_share: float | None = None

    @property
    def ok(self) -> bool:
        """Whether the picture was located."""
        return self.status == LOCATED

    @property
    def inlier_share(self) -> float | None:
        """Inliers per match; None without matches."""
        return share(self.inliers, self.matches)


@dataclass(frozen=True)
class PoseSummary:
    """The probe's findings over a set of pictures.

    Statistics are over the located pictures alone, None without any, and say how many those are;
    they flatter a set whose hard pictures fail, and are to be read beside ``success_share``.
    ``rotation_auc`` counts failures as wrong.
    """

    pictures: int  # how many were probed
    located: int  # how many of them were located
    success_share: float | None  # located per picture; None without pictures
    failures: tuple[tuple[str, str], ...]  # name and status of every picture that was not
    rotation_error_deg: ErrorStatistics | None
    center_error: ErrorStatistics | None  # scene units
    center_error_share: ErrorStatistics | None  # of the extent of the context's centres
    # By threshold in degrees, the area under the share of *all* pictures that are located with a
    # rotation error below x, for x up to the threshold; None without pictures.
    rotation_auc: dict[float, float | None]
    inliers: ErrorStatistics | None  # places that agree with the pose
    inlier_share: ErrorStatistics | None  # those per match


def summarise(found: Sequence[Located]) -> PoseSummary:
    """The findings of all probed pictures; leave none out, failures least of all."""
    ok = [one for one in found if one.ok]
    angles = [np.inf if one.rotation_error_deg is None else one.rotation_error_deg for one in found]

    def statistics(name: str) -> ErrorStatistics | None:
        values = [getattr(one, name) for one in ok]
        return ErrorStatistics.of([value for value in values if value is not None])

    return PoseSummary(
        pictures=len(found),
        located=len(ok),
        success_share=share(len(ok), len(found)),
        failures=tuple((one.name, one.status) for one in found if not one.ok),
        rotation_error_deg=statistics("rotation_error_deg"),
        center_error=statistics("center_error"),
        center_error_share=statistics("center_error_share"),
        rotation_auc={
            threshold: area_under_recall(angles, threshold) if found else None
            for threshold in AUC_THRESHOLDS
        },
        inliers=statistics("inliers"),
        inlier_share=statistics("inlier_share"),
    )


@dataclass(frozen=True, eq=False)
class _ContextView:
    """A context view's keypoints that have a 3D point: features (N), points (N, 3)."""

    name: str
    features: Features
    points: Float64


class PoseProbe:
    """Locates pictures against posed context views with depth.

    The depth is from any source (measured, or the memory's projection); views without it give no
    points. The same seed gives the same answer.
    """

    def __init__(
        self,
        context: Sequence[PosedPicture],
        *,
        matcher: FeatureMatcher | None = None,
        seed: int = 0,
    ) -> None:
        self.seed = seed
        self._matcher = matcher or SiftMatcher()
        self._context = tuple(context)
        self._views = [self._lifted(picture) for picture in self._context]
        if not any(len(view.points) for view in self._views):
            raise DegenerateError(
                f"pose probe: none of {len(self._context)} context views has keypoints with depth; "
                "give views with texture and depth"
            )
        self.extent = center_extent(
            concatenate([picture.camera for picture in self._context]).world_from_cam
        )

    def locate(self, picture: PosedPicture, *, leave_out: Collection[str] = ()) -> Located:
        """Where a picture looks from, by its pixels alone.

        Its mask limits the keypoints; its camera's pose is only compared with. Context views whose
        names are left out are not matched.
        """
        features = self._features(picture)
        views = self._promising(features, leave_out)
        pose, counts = self._solved(features, views, picture.camera.K[0])
        reason = self._reason(counts)
        status = f"failed: {reason}" if reason else LOCATED
        located = Located(
            name=picture.name,
            status=status,
            views=tuple(view.name for view in views),
            **asdict(counts),
        )
        if pose is None or reason:
            return located
        requested = picture.camera.cam_from_world[0]
        distance = center_distance(pose.cam_from_world, requested)
        return replace(
            located,
            cam_from_world=pose.cam_from_world,
            residual=pose.rms,
            rotation_error_deg=angle_deg(pose.cam_from_world[:3, :3], requested[:3, :3]),
            center_error=distance,
            center_error_share=share(distance, self.extent),
        )

    def leave_one_out(self, count: int | None = None) -> list[Located]:
        """So many context views located by the others: the probe's error on real pictures.

        What a generated picture is off by means little below it.
        """
        pictures = [self._context[i] for i in spread(len(self._context), count)]
        return [self.locate(picture, leave_out=(picture.name,)) for picture in pictures]

    def _features(self, picture: PosedPicture) -> Features:
        """The picture's keypoints in pixels that its mask does not leave out."""
        features = self._matcher.extract(picture.rgb)
        if picture.mask is None:
            return features
        height, width = picture.mask.shape
        pixels = np.floor(features.xy).astype(np.int64)
        x, y = np.clip(pixels, 0, [width - 1, height - 1]).T
        return features[picture.mask[y, x]]

    def _lifted(self, picture: PosedPicture) -> _ContextView:
        features = self._features(picture)
        if picture.depth is None:
            return _ContextView(picture.name, features[:0], np.zeros((0, 3)))
        points, ok = lift_keypoints(features.xy, picture.depth, picture.camera, edge=EDGE)
        return _ContextView(picture.name, features[ok], points[ok])

    def _promising(self, features: Features, leave_out: Collection[str]) -> list[_ContextView]:
        """The views whose most prominent keypoints match those of the picture most often."""
        views = [view for view in self._views if view.name not in leave_out and len(view.points)]
        if len(views) <= VIEWS:
            return views
        own = features.descriptors[:PROMINENT]
        votes = [len(mutual_nearest(own, view.features.descriptors[:PROMINENT])) for view in views]
        order = np.argsort(-np.asarray(votes), kind="stable")[:VIEWS]
        return [views[i] for i in order]

    def _solved(
        self, features: Features, views: Sequence[_ContextView], K: Float64
    ) -> tuple[AbsolutePose | None, _Counts]:
        """The best pose by the matches with all views, and what speaks for and against it."""
        pairs = [self._matcher.match(features, view.features) for view in views]
        xy = np.concatenate([features.xy[:0], *(features.xy[rows[:, 0]] for rows in pairs)])
        matched = [view.points[rows[:, 1]] for view, rows in zip(views, pairs, strict=True)]
        points = np.concatenate([np.zeros((0, 3)), *matched])
        # A keypoint may have several orientations: places are counted, not keypoints.
        places, place = np.unique(xy, axis=0, return_inverse=True)
        place = place.reshape(-1)
        side = max(features.width, features.height)
        error = max(2.0, side / 160)
        pose = absolute_pose(xy, points, K, max_error=error, seed=self.seed)
        if pose is None:
            return None, _Counts(keypoints=len(features), matches=len(places))
        agreed = np.unique(place[pose.inliers])
        rival = rival_pose(
            xy,
            points,
            K,
            pose=pose,
            max_error=error,
            least_share=MAX_RIVAL,
            seed=self.seed,
        )
        return pose, _Counts(
            keypoints=len(features),
            matches=len(places),
            inliers=len(agreed),
            cells=len(np.unique(np.floor(places[agreed] / (side / CELLS)), axis=0)),
            rival=0 if rival is None else len(np.unique(place[rival.inliers])),
        )

    def _reason(self, counts: _Counts) -> str:
        """Why a picture does not count as located; empty when it does."""
        inliers, least = f"{counts.inliers} inliers", f"at least {MIN_INLIERS} are needed"
        if counts.matches < MIN_INLIERS:
            return f"{counts.matches} matches of {counts.keypoints} keypoints, {least}"
        if counts.inliers < MIN_INLIERS:
            return f"{inliers} of {counts.matches} matches, {least}"
        if counts.cells < MIN_CELLS:
            cells = f"{counts.cells} cells of the picture"
            return f"{inliers} in {cells}, at least {MIN_CELLS} are needed"
        if counts.rival >= MAX_RIVAL * counts.inliers:
            return (
                f"ambiguous, {counts.inliers} matches agree on one pose and {counts.rival} on "
                "another that contradicts it"
            )
        return ""
