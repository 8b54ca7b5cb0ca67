# mypy: no-check-untyped-defs
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from gvtools.cameras import concatenate
from gvtools.poses import bundle_adjustment
from gvtools.poses.bundle_adjustment import Tracks, adjusted_poses
from gvtools.poses.motions import move_pose
from gvtools.scenes.scene import Frame

VIEWS = 8


@pytest.fixture(scope="module")
def room(wall_walk):
    frames = [Frame(view.rgb, view.depth) for view in wall_walk[:VIEWS]]
    return frames, concatenate([view.camera for view in wall_walk[:VIEWS]])


@pytest.fixture(scope="module")
def found(room):
    """Poses adjusted to features from ones that are off."""
    frames, cameras = room
    return adjusted_poses(frames, off(cameras))


def off(cameras, *, by=0.02):
    """The cameras with poses as a tracker errs, by shifts and radians."""
    rng = np.random.default_rng(0)
    poses = [move_pose(pose, rng.normal(0, by, 6)) for pose in cameras.cam_from_world]
    return replace(cameras, cam_from_world=np.stack(poses))


def relative_turns(poses, truth):
    """Degrees by which relative poses of neighbours are off."""
    apart = [
        poses[i + 1] @ np.linalg.inv(poses[i]) @ truth[i] @ np.linalg.inv(truth[i + 1])
        for i in range(len(poses) - 1)
    ]
    cosines = [(np.trace(each[:3, :3]) - 1) / 2 for each in apart]
    return float(np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1)))))


def tracks_through(cameras, *, noise=0.3):
    """Points in a box before the cameras, and where these see them."""
    rng = np.random.default_rng(1)
    center = cameras.centers.mean(axis=0) + 3 * cameras.cam_from_world[0, 2, :3]
    points = center + rng.uniform(-1.5, 1.5, (400, 3))
    xy, z = cameras.project(points)
    size = np.stack([cameras.width, cameras.height], axis=1)[:, None]
    seen = (z > 0.1) & (xy > 0).all(axis=2) & (xy < size).all(axis=2)
    twice = seen.sum(axis=0) > 1
    seen, xy, points = seen[:, twice], xy[:, twice], points[twice]
    view, point = np.nonzero(seen)
    return Tracks(points, point, view, xy[view, point] + rng.normal(0, noise, (len(view), 2)))


def test_features_correct_a_trackers_poses(room, found):
    frames, cameras = room
    given = off(cameras)
    before = relative_turns(given.cam_from_world, cameras.cam_from_world)
    assert relative_turns(found.poses, cameras.cam_from_world) < 0.25 * before
    assert found.errors[1] < 1 < found.errors[0]
    scaled = found.scaled(frames, given)
    baselines = [np.ptp(-np.einsum("vji,vj->vi", p[:, :3, :3], p[:, :3, 3]), axis=0).max()
                 for p in (scaled, cameras.cam_from_world)]  # fmt: skip
    assert baselines[0] == pytest.approx(baselines[1], rel=0.03)


def test_pictures_may_have_several_sizes(room):
    frames, cameras = room
    given, K = off(cameras), cameras.K.copy()
    K[::2, :2] *= 2
    mixed = [
        replace(frame, rgb=cv2.resize(frame.rgb, None, fx=2, fy=2)) if row % 2 == 0 else frame
        for row, frame in enumerate(frames)
    ]
    times = np.where(np.arange(VIEWS) % 2 == 0, 2, 1)
    size = {"width": cameras.width * times, "height": cameras.height * times}
    found = adjusted_poses(mixed, replace(given, K=K, **size))
    assert (np.bincount(found.tracks.view, minlength=VIEWS) >= bundle_adjustment.LEAST_SEEN).all()
    before = relative_turns(given.cam_from_world, cameras.cam_from_world)
    assert relative_turns(found.poses, cameras.cam_from_world) < 0.25 * before


def test_exact_poses_stay(room):
    frames, cameras = room
    assert adjusted_poses(frames, cameras) is None
    assert adjusted_poses(frames, cameras, tracks=tracks_through(cameras)) is None


def test_known_tracks_need_no_picture(room, monkeypatch):
    frames, cameras = room
    monkeypatch.setattr(bundle_adjustment, "_triangulate", None)
    tracks, given = tracks_through(cameras), off(cameras)
    assert tracks.exact(cameras)
    assert not tracks.exact(given)
    found = adjusted_poses(frames, given, tracks=tracks)
    before = relative_turns(given.cam_from_world, cameras.cam_from_world)
    assert relative_turns(found.poses, cameras.cam_from_world) < 0.25 * before


def test_some_of_the_tracks_tell_whether_poses_err(room, monkeypatch):
    cameras, tracks, solved = room[1], tracks_through(room[1]), []
    whole, adjust = adjusted_poses([], off(cameras), tracks=tracks), bundle_adjustment.adjust

    def counted(model, options):
        solved.append(len(model.points3D))
        adjust(model, options)

    monkeypatch.setattr(bundle_adjustment, "adjust", counted)
    monkeypatch.setattr(bundle_adjustment, "SAMPLED", len(tracks.view) // 3)
    assert adjusted_poses([], cameras, tracks=tracks) is None
    assert max(solved) < 0.4 * len(tracks.positions)
    np.testing.assert_array_equal(
        adjusted_poses([], off(cameras), tracks=tracks).poses, whole.poses
    )


def test_other_cameras_move_only_if_they_err_alike(room):
    frames, cameras = room
    drift = np.linspace(-1, 1, VIEWS)[:, None] * [0.1, 0, 0, 0, 0.1, 0]
    drift += np.random.default_rng(0).normal(0, 0.001, drift.shape)
    poses = [move_pose(pose, by) for pose, by in zip(cameras.cam_from_world, drift, strict=True)]
    tracks = tracks_through(cameras, noise=0.2)
    for given, alike in (
        (off(cameras), False),
        (replace(cameras, cam_from_world=np.stack(poses)), True),
    ):
        found = adjusted_poses(frames, given, tracks=tracks)
        assert found.refined(given).spread == alike


def test_the_result_is_the_same_every_time(room, found):
    frames, cameras = room
    np.testing.assert_array_equal(adjusted_poses(frames, off(cameras)).poses, found.poses)


def test_pictures_without_features_tell_nothing(room):
    frames, cameras = room
    blank = [replace(frame, rgb=np.full_like(frame.rgb, 90)) for frame in frames]
    assert adjusted_poses(blank, off(cameras)) is None
    assert adjusted_poses(frames[:1], cameras[:1]) is None
