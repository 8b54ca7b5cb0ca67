"""Bundle adjustment of poses that are given: by SIFT of neighbouring pictures, or by known tracks.

Poses of a phone's or a sensor's tracker miss what pictures show by several pixels, which blurs all
that is made of them. Features tell poses to a fraction of a pixel; intrinsics stay as they are.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64
from gvtools.features import quiet_colmap
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.poses.colmap import (
    SEED,
    adjust,
    extract_sift,
    fix_cameras,
    list_pairs,
    posed_model,
    set_intrinsics,
    verification,
    write_pictures,
)
from gvtools.poses.motions import centers_of, mean_near, motions_between, move_pose, nearest_pairs
from gvtools.poses.refinement import RefinedPoses
from gvtools.scenes.colmap_writer import build_reconstruction
from gvtools.scenes.scene import Frame, Scene
from gvtools.similarity import align_poses

if TYPE_CHECKING:
    import pycolmap


# Features of more pictures take minutes.
MOST_VIEWS = 150
# Features of a picture, the longer side at which they are found [px], and neighbours that each
# picture is matched with.
FEATURES, SIDE, NEIGHBOURS = 2048, 640, 8
# Reprojection errors up to which points stay, round by round [px].
ROUNDS = (12.0, 8.0, 4.0)
# A view with fewer detections takes its neighbours' correction; a model of fewer points is refused.
LEAST_SEEN, LEAST_POINTS = 20, 100
# Known tracks with a smaller median reprojection error: poses were adjusted to them before [px].
EXACT = 1.0
# More known points than this tell no more; those of the longest tracks count.
MOST_POINTS = 20_000
# Whether poses err at all is asked of about so many detections: less time where they do not.
SAMPLED = 30_000
# Poses are taken where they lower the median error to this share.
MAX_ERROR_RATIO = 0.7
# Focal lengths that features change by more [log] are not told by them.
MAX_FOCAL_CHANGE = 0.25


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points (N, 3) in the world of the cameras, and where at least two pictures show each."""

    positions: Float64
    # Of each of M detections its point, its camera and where it is [px].
    point: NDArray[np.int64]
    view: NDArray[np.int64]
    xy: Float64

    def reprojection_errors(self, cameras: Cameras, poses: Float64) -> Float64:
        """(M,) distances of detections from where cameras at some poses see their points [px]."""
        local = self.local(poses)
        seen = np.einsum("mij,mj->mi", cameras.K[self.view], local)
        ahead = local[:, 2] > 0
        xy = seen[:, :2] / np.where(ahead, local[:, 2], 1)[:, None]
        return np.where(ahead, np.linalg.norm(xy - self.xy, axis=1), np.inf)

    def local(self, poses: Float64) -> Float64:
        """(M, 3) each detection's point in the frame of its camera at a pose; z is its depth."""
        pose = poses[self.view]
        turned = np.einsum("mij,mj->mi", pose[:, :3, :3], self.positions[self.point])
        return np.asarray(turned + pose[:, :3, 3])

    def every(self, step: int) -> Tracks:
        """One of so many points, with all of its detections."""
        use = self.point % step == 0
        return Tracks(self.positions[::step], self.point[use] // step, self.view[use], self.xy[use])

    def exact(self, cameras: Cameras) -> bool:
        """Whether poses are the best that features tell: a model was adjusted to them before."""
        return float(np.median(self.reprojection_errors(cameras, cameras.cam_from_world))) < EXACT


@dataclass(frozen=True, eq=False)
class AdjustedPoses:
    """Poses (V, 4, 4) camera from world on which features agree, together where the given ones are.

    ``errors`` are the median reprojection errors with the given poses and with these [px].
    """

    poses: Float64
    tracks: Tracks
    errors: tuple[float, float]

    def scaled(self, frames: Sequence[Frame], given: Cameras) -> Float64 | None:
        """(V, 4, 4) the poses at the scale of recorded depth; None where that tells none."""
        z, recorded = self.tracks.local(self.poses)[:, 2], np.zeros(len(self.tracks.xy))
        for row, frame in enumerate(frames):
            mine = self.tracks.view == row
            x, y = self.tracks.xy[mine].astype(int).T
            if frame.depth is not None:
                height, width = frame.depth.shape
                recorded[mine] = frame.depth[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
        both = (recorded > 0) & (z > 0)
        if both.sum() < LEAST_POINTS:
            return None
        poses = self.poses.copy()
        poses[:, :3, 3] *= np.median(recorded[both] / z[both])
        return np.asarray(poses @ align_poses(poses, given.cam_from_world))

    def refined(self, given: Cameras) -> RefinedPoses:
        """As ``RefinedPoses``; targets follow if their neighbours' corrections predict views."""
        depth = float(np.median(self.tracks.local(self.poses)[:, 2]))
        before = given.cam_from_world
        found = RefinedPoses(before, self.poses, depth, False, self.errors, True, True)
        near, away = (
            float(np.median(self.tracks.reprojection_errors(given, poses)))
            for poses in (found.like_neighbours(), before)
        )
        return replace(found, spread=near < MAX_ERROR_RATIO * away)


def adjusted_poses(
    frames: Sequence[Frame], cameras: Cameras, *, tracks: Tracks | None = None
) -> AdjustedPoses | None:
    """Adjust poses to what pictures show; None where the given ones are as good, or nothing tells.

    Args:
        frames: pixels of the views; may be empty with ``tracks``.
        cameras: their cameras, without skew.
        tracks: known ones, as those of a project's sparse points; None finds features.
    """
    if not can_adjust(cameras, tracks):
        return None
    with quiet_colmap(errors=False):
        if tracks is None:
            with tempfile.TemporaryDirectory() as folder:
                model = _triangulate(frames, cameras, Path(folder))
        else:
            if len(tracks.view) >= 2 * SAMPLED:
                some = _model(cameras, tracks.every(len(tracks.view) // SAMPLED))
                _solve(some, ROUNDS[-1])
                if _better(some, cameras) is None:
                    return None
            model = _model(cameras, tracks)
            _solve(model, ROUNDS[-1])
        better = None if model is None else _better(model, cameras)
    if better is None:
        return None
    poses, found, errors = better
    well_observed = np.bincount(found.view, minlength=len(cameras)) >= LEAST_SEEN
    if well_observed.mean() < 0.5:
        return None
    return _place(poses, found, cameras, well_observed=well_observed, errors=errors)


def _better(
    model: pycolmap.Reconstruction, cameras: Cameras
) -> tuple[Float64, Tracks, tuple[float, float]] | None:
    """A solved model's poses, tracks, and errors before and after; None: no better."""
    if len(model.points3D) < LEAST_POINTS:
        return None
    poses, found = _poses_and_tracks(model, cameras)
    given = _model(cameras, found)
    _solve(given, None)
    tracks = _poses_and_tracks(given, cameras)[1]
    before, after = (
        float(np.median(each.reprojection_errors(cameras, at)))
        for each, at in ((tracks, cameras.cam_from_world), (found, poses))
    )
    return (poses, found, (before, after)) if after < MAX_ERROR_RATIO * before else None


def refine_focals(cameras: Cameras, tracks: Tracks) -> tuple[Cameras, Tracks]:
    """Adjust focal lengths as well, one of all cameras of equal K, where features tell them."""
    with quiet_colmap(errors=False):
        model = _model(cameras, tracks)
        options = _options()
        options.refine_focal_length = True
        adjust(model, options)
        poses, found = _poses_and_tracks(model, cameras)
    lenses = [model.cameras[model.images[row + 1].camera_id] for row in range(len(poses))]
    K = np.array([lens.calibration_matrix() for lens in lenses])
    refined = replace(cameras, K=K, cam_from_world=poses)
    before, after = (
        float(np.median(each.reprojection_errors(seen, seen.cam_from_world)))
        for each, seen in ((tracks, cameras), (found, refined))
    )
    # A median of so many errors falls by less than this by chance.
    told = after < (1 - 2 / np.sqrt(len(tracks.view))) * before
    if not told or np.abs(np.log(K[:, 0, 0] / cameras.K[:, 0, 0])).max() > MAX_FOCAL_CHANGE:
        return cameras, tracks
    return refined, found


def can_adjust(cameras: Cameras, tracks: Tracks | None) -> bool:
    """Whether there are enough views, not too many to find features in, and none with skew."""
    enough = len(cameras) >= 2 and (tracks is not None or len(cameras) <= MOST_VIEWS)
    return enough and not cameras.K[:, 0, 1].any()


def tracks_of(scene: Scene, names: Sequence[str], frame: LocalFrame) -> Tracks | None:
    """The tracks of a project's sparse points in some views, numbered so; None for too few."""
    points = scene.points
    if points is None or not len(points.view_index):
        return None
    row = np.full(len(scene.names), -1)
    row[[scene.names.index(name) for name in names]] = np.arange(len(names))
    view = row[points.view_index]
    counts = np.bincount(points.point_index[view >= 0], minlength=len(points.positions))
    kept = np.flatnonzero(counts > 1)
    kept = np.sort(kept[np.argsort(-counts[kept], kind="stable")[:MOST_POINTS]])
    number = np.full(len(points.positions), -1)
    number[kept] = np.arange(len(kept))
    use = (view >= 0) & (number[points.point_index] >= 0)
    if len(kept) < LEAST_POINTS:
        return None
    return Tracks(
        frame.from_world(points.positions[kept]), number[points.point_index[use]], view[use],
        points.xy[use],
    )  # fmt: skip


def _place(
    poses: Float64, tracks: Tracks, cameras: Cameras, *, well_observed: NDArray[np.bool_],
    errors: tuple[float, float],
) -> AdjustedPoses:  # fmt: skip
    """Poses and tracks in the given world; views that too few points tell move like others."""
    given = cameras.cam_from_world
    size = [
        float(np.sqrt(centers_of(each[well_observed]).var(axis=0).sum())) for each in (given, poses)
    ]
    scale = size[0] / size[1] if min(size) > 0 else 1.0
    poses, positions = poses.copy(), tracks.positions * scale
    poses[:, :3, 3] *= scale
    world_from_given = align_poses(poses[well_observed], given[well_observed])
    poses = poses @ world_from_given
    back = np.linalg.inv(world_from_given)
    tracks = Tracks(positions @ back[:3, :3].T + back[:3, 3], tracks.point, tracks.view, tracks.xy)
    depth = float(np.median(tracks.local(poses)[:, 2]))
    changes = motions_between(given, poses)
    for row in np.flatnonzero(~well_observed):
        change = mean_near(given[row], given[well_observed], changes[well_observed], depth=depth)
        poses[row] = move_pose(given[row], change)
    return AdjustedPoses(poses, tracks, errors)


def _triangulate(
    frames: Sequence[Frame], cameras: Cameras, work: Path
) -> pycolmap.Reconstruction | None:
    """Points of the pictures' features, and poses adjusted to them; None where hardly any match."""
    from gvtools.colmap import pycolmap

    names = write_pictures(((frame.rgb, frame.mask) for frame in frames), work)
    images, database = work / "images", work / "database.db"
    pycolmap.Database.open(database).close()
    # Images get the ids 1 to V in this order; extraction alone would number them as threads end.
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE")
    mode = pycolmap.CameraMode.PER_IMAGE
    pycolmap.import_images(database, images, mode, image_names=names, options=reader)
    extract_sift(
        database, images, names, masks=work / "masks", reader=reader, side=SIDE, features=FEATURES,
        first_octave=0, one_camera=False,
    )  # fmt: skip
    set_intrinsics(database, cameras.K)
    model = posed_model(database, cameras.cam_from_world)
    centers = cameras.centers
    unit = max(float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))), 1e-9)
    near = nearest_pairs(cameras.cam_from_world, count=NEIGHBOURS, shift=unit)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = list_pairs([(names[a], names[b]) for a, b in near], work)
    matching = pycolmap.FeatureMatchingOptions()
    # Indices built side by side share BLAS's threads, and round as these happen to be free.
    matching.num_threads = 1
    pycolmap.match_image_pairs(
        database, matching_options=matching, pairing_options=pairing,
        verification_options=verification(),
    )  # fmt: skip
    options = pycolmap.IncrementalPipelineOptions()
    options.triangulation.ignore_two_view_tracks = False
    options.random_seed = options.triangulation.random_seed = SEED
    for error in ROUNDS:
        options.mapper.filter_max_reproj_error = error
        model = pycolmap.triangulate_points(
            model, database, images, work, clear_points=True, options=options
        )
        if len(model.points3D) < LEAST_POINTS:
            return None
        _solve(model, error)
    return model


def _model(cameras: Cameras, tracks: Tracks) -> pycolmap.Reconstruction:
    """Views at their given poses with the points that they show; image ids are rows + 1."""
    black = np.zeros(tracks.positions.shape, np.uint8)
    return build_reconstruction(
        cameras, tracks.positions, black, point_index=tracks.point, view_index=tracks.view,
        xy=tracks.xy,
    )  # fmt: skip


def _solve(model: pycolmap.Reconstruction, error: float | None) -> None:
    """Adjust poses and points, then drop points beyond ``error`` px; None: points alone move."""
    from gvtools.colmap import pycolmap

    options = _options()
    options.refine_rig_from_world = error is not None
    adjust(model, options)
    if error is not None:
        pycolmap.ObservationManager(model).filter_all_points3D(error, 0.0)


def _options() -> pycolmap.BundleAdjustmentOptions:
    """Intrinsics stay as they are."""
    from gvtools.colmap import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    fix_cameras(options)
    options.refine_principal_point = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    # In any order of threads sums differ in their last digits.
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = 30
    return options


def _poses_and_tracks(model: pycolmap.Reconstruction, cameras: Cameras) -> tuple[Float64, Tracks]:
    """Poses, and tracks of the points; image ids are rows + 1."""
    poses = cameras.cam_from_world.copy()
    for number, image in model.images.items():
        poses[number - 1, :3] = image.cam_from_world().matrix()
    positions, point, view, xy = [], [], [], []
    for index, number in enumerate(sorted(model.points3D)):
        positions.append(model.points3D[number].xyz)
        for element in model.points3D[number].track.elements:
            point.append(index)
            view.append(element.image_id - 1)
            xy.append(model.images[element.image_id].points2D[element.point2D_idx].xy)
    return poses, Tracks(
        np.array(positions).reshape(-1, 3), np.array(point, np.int64), np.array(view, np.int64),
        np.array(xy, np.float64).reshape(-1, 2),
    )  # fmt: skip
