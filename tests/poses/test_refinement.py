"""Poses by odometry between views and by bundle adjustment: back to the truth, never worse."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from splat_scene import photographs, pose_errors, walk

from gvtools.cameras import concatenate
from gvtools.poses import bundle_adjustment
from gvtools.poses.bundle_adjustment import Tracks, adjusted_poses
from gvtools.poses.motions import centers_of, move_pose, nearest_pairs, turn_of
from gvtools.poses.refinement import FitView, agreeing_poses, refined_poses
from gvtools.scenes.scene import Frame
from gvtools.similarity import align_poses

COUNT, SIZE = 8, 3


@pytest.fixture(scope="module")
def truth():
    return walk(COUNT)


@pytest.fixture(scope="module")
def views(truth):
    return textured(truth)


def textured(poses: np.ndarray) -> list[FitView]:
    """Exact views of a square before a wall with patterns of all sizes."""
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(24, 3)) * np.geomspace(3, 30, 24)[:, None]
    phases = rng.uniform(0, 2 * np.pi, 24)
    views = []
    for view in photographs(poses, depth=True, size=SIZE):
        height, width = view.rgb.shape[:2]
        assert view.depth is not None
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        points = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.K).T
        points = (points * view.depth[..., None] - view.cam_from_local[:3, 3]) @ (
            view.cam_from_local[:3, :3]
        )
        grey = 128 + 18 * np.sin(points @ waves.T + phases).sum(-1)
        rgb = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)
        views.append(replace(view, rgb=rgb))
    return views


def off(views, *, scale: float = 1.0, seed: int = 1):
    """The views with poses that err by some two centimetres and half a degree."""
    rng = np.random.default_rng(seed)
    motions = rng.normal(0, scale * np.repeat([0.02, 0.01], 3), (len(views), 6))
    return [
        replace(view, cam_from_local=move_pose(view.cam_from_local, motion))
        for view, motion in zip(views, motions, strict=True)
    ]


def poses_of(views) -> np.ndarray:
    return np.stack([view.cam_from_local for view in views])


def test_relative_poses_come_back_and_the_whole_stays_where_it_was(views, truth):
    some = off(views)
    found = agreeing_poses(some)
    before, after = pose_errors(poses_of(some), truth), pose_errors(found, truth)
    assert after[0] < 0.35 * before[0]
    assert after[1] < 0.35 * before[1]
    np.testing.assert_allclose(align_poses(found, poses_of(some)), np.eye(4), atol=1e-9)


def test_views_may_have_sizes_and_intrinsics_of_their_own(views, truth):
    some = off(views)
    for row in (0, 3, 5):
        view = some[row]
        assert view.depth is not None
        K, rgb, depth = view.K.copy(), view.rgb[::2, ::2], view.depth[::2, ::2]
        if row == 3:
            K[:2, 2] += 4
            rgb = np.pad(view.rgb, ((4, 0), (4, 0), (0, 0)), mode="edge")[:-4, :-4]
            depth = np.pad(view.depth, ((4, 0), (4, 0)))[:-4, :-4]
        else:
            K[:2] /= 2
        some[row] = replace(view, K=K, rgb=rgb, depth=depth)
    before, after = pose_errors(poses_of(some), truth), pose_errors(agreeing_poses(some), truth)
    assert after[0] < 0.6 * before[0]


def test_views_without_depth_and_masked_pixels_are_passed_over(views, truth):
    some = off(views)
    assert some[2].depth is not None and some[4].depth is not None
    some[2] = replace(some[2], depth=np.zeros_like(some[2].depth))
    mask = np.ones(some[4].depth.shape, bool)
    mask[:, :60] = False
    wrong = np.where(mask, some[4].depth, np.float32(9))
    some[4] = replace(some[4], depth=wrong, mask=mask)
    found = agreeing_poses(some)
    rows = [0, 1, 3, 4, 5, 6, 7]
    before, after = (pose_errors(p[rows], truth[rows]) for p in (poses_of(some), found))
    assert after[0] < 0.5 * before[0]


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(views, truth, unit):
    some = off(views)
    other = []
    for view in some:
        pose = view.cam_from_local.copy()
        pose[:3, 3] *= unit
        assert view.depth is not None
        other.append(replace(view, cam_from_local=pose, depth=view.depth * np.float32(unit)))
    expected, found = agreeing_poses(some), agreeing_poses(other)
    found[:, :3, 3] /= unit
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_views_that_see_nothing_in_common_stay_where_they_were(views):
    apart = []
    for row, view in enumerate(views[:3]):
        pose = view.cam_from_local.copy()
        pose[0, 3] += 100 * row
        apart.append(replace(view, cam_from_local=pose))
    np.testing.assert_allclose(agreeing_poses(apart), poses_of(apart), atol=1e-6)
    empty = [replace(view, depth=np.zeros_like(view.depth)) for view in views[:3]]
    np.testing.assert_array_equal(agreeing_poses(empty), poses_of(empty))


def test_every_camera_is_compared_with_the_nearest():
    poses = walk(6)
    pairs = nearest_pairs(poses, count=1, shift=2.0)
    assert all(second - first <= 2 for first, second in pairs)
    assert {row for pair in pairs for row in pair} == set(range(6))
    assert nearest_pairs(poses[:1], count=3, shift=2.0) == []


def test_right_poses_are_kept_and_wrong_ones_are_not(views, truth):
    assert refined_poses(views[:1]) is None
    found = refined_poses(off(views))
    assert found is not None
    assert found.errors[1] < found.errors[0]
    assert pose_errors(found.poses, truth)[0] < 0.01
    assert "degrees" in str(found)
    assert refined_poses(views) is None


def test_other_cameras_move_only_if_neighbours_err_alike(views, truth):
    jumps = refined_poses(off(views))
    assert jumps is not None and not jumps.spread
    np.testing.assert_array_equal(jumps.corrected(truth[3]), truth[3])
    # Half of the path is off by one motion, half by the opposite one.
    motion = np.array([0.03, 0.01, 0, 0, 0.01, 0])
    signs = np.where(np.arange(2 * COUNT) < COUNT, 1, -1)
    path = walk(2 * COUNT)
    drifting = [
        replace(view, cam_from_local=move_pose(pose, sign * motion))
        for view, pose, sign in zip(textured(path), path, signs, strict=True)
    ]
    drift = refined_poses(drifting)
    assert drift is not None and drift.spread
    for row in (3, 12):
        other = move_pose(path[row], signs[row] * motion)
        before = pose_errors(np.stack([other, path[8]]), path[[row, 8]])
        after = pose_errors(np.stack([drift.corrected(other), path[8]]), path[[row, 8]])
        assert after[0] < before[0]


VIEWS = 8


@pytest.fixture(scope="module")
def room(wall_walk):
    frames = [Frame(view.rgb, view.depth) for view in wall_walk[:VIEWS]]
    return frames, concatenate([view.camera for view in wall_walk[:VIEWS]])


@pytest.fixture(scope="module")
def found(room):
    """Poses adjusted to features from ones that are off."""
    frames, cameras = room
    return adjusted_poses(frames, tracked(cameras))


def tracked(cameras, *, by=0.02):
    """The cameras with poses as a tracker errs, by shifts and radians."""
    rng = np.random.default_rng(0)
    poses = [move_pose(pose, rng.normal(0, by, 6)) for pose in cameras.cam_from_world]
    return replace(cameras, cam_from_world=np.stack(poses))


def left_of_turns(found, given, truth):
    """What is left of the degrees by which relative poses of neighbours were off."""
    after, before = (relative_turns(p, truth.cam_from_world) for p in (found, given.cam_from_world))
    return after / before


def relative_turns(poses, truth):
    """Degrees by which relative poses of neighbours are off."""
    apart = [
        poses[i + 1] @ np.linalg.inv(poses[i]) @ truth[i] @ np.linalg.inv(truth[i + 1])
        for i in range(len(poses) - 1)
    ]
    return float(np.degrees(np.median([turn_of(each) for each in apart])))


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
    given = tracked(cameras)
    assert left_of_turns(found.poses, given, cameras) < 0.25
    assert found.errors[1] < 1 < found.errors[0]
    both = found.scaled(frames, given), cameras.cam_from_world
    baselines = [np.ptp(centers_of(poses), axis=0).max() for poses in both]
    assert baselines[0] == pytest.approx(baselines[1], rel=0.03)


def test_pictures_may_have_several_sizes(room):
    frames, cameras = room
    given, K = tracked(cameras), cameras.K.copy()
    K[::2, :2] *= 2
    mixed = [
        replace(frame, rgb=cv2.resize(frame.rgb, None, fx=2, fy=2)) if row % 2 == 0 else frame
        for row, frame in enumerate(frames)
    ]
    times = np.where(np.arange(VIEWS) % 2 == 0, 2, 1)
    size = {"width": cameras.width * times, "height": cameras.height * times}
    found = adjusted_poses(mixed, replace(given, K=K, **size))
    assert (np.bincount(found.tracks.view, minlength=VIEWS) >= bundle_adjustment.LEAST_SEEN).all()
    assert left_of_turns(found.poses, given, cameras) < 0.25


def test_exact_poses_stay(room):
    frames, cameras = room
    assert adjusted_poses(frames, cameras) is None
    assert adjusted_poses(frames, cameras, tracks=tracks_through(cameras)) is None


def test_known_tracks_need_no_picture(room, monkeypatch):
    frames, cameras = room
    monkeypatch.setattr(bundle_adjustment, "_triangulate", None)
    tracks, given = tracks_through(cameras), tracked(cameras)
    assert tracks.exact(cameras)
    assert not tracks.exact(given)
    found = adjusted_poses(frames, given, tracks=tracks)
    assert left_of_turns(found.poses, given, cameras) < 0.25


def test_some_of_the_tracks_tell_whether_poses_err(room, monkeypatch):
    cameras, tracks, solved = room[1], tracks_through(room[1]), []
    whole, adjust = adjusted_poses([], tracked(cameras), tracks=tracks), bundle_adjustment.adjust

    def counted(model, options):
        solved.append(len(model.points3D))
        adjust(model, options)

    monkeypatch.setattr(bundle_adjustment, "adjust", counted)
    monkeypatch.setattr(bundle_adjustment, "SAMPLED", len(tracks.view) // 3)
    assert adjusted_poses([], cameras, tracks=tracks) is None
    assert max(solved) < 0.4 * len(tracks.positions)
    np.testing.assert_array_equal(
        adjusted_poses([], tracked(cameras), tracks=tracks).poses, whole.poses
    )


def test_other_cameras_move_only_if_they_err_alike(room):
    frames, cameras = room
    drift = np.linspace(-1, 1, VIEWS)[:, None] * [0.1, 0, 0, 0, 0.1, 0]
    drift += np.random.default_rng(0).normal(0, 0.001, drift.shape)
    poses = [move_pose(pose, by) for pose, by in zip(cameras.cam_from_world, drift, strict=True)]
    tracks = tracks_through(cameras, noise=0.2)
    for given, alike in (
        (tracked(cameras), False),
        (replace(cameras, cam_from_world=np.stack(poses)), True),
    ):
        found = adjusted_poses(frames, given, tracks=tracks)
        assert found.refined(given).spread == alike


def test_pictures_without_features_tell_nothing(room):
    frames, cameras = room
    blank = [replace(frame, rgb=np.full_like(frame.rgb, 90)) for frame in frames]
    assert adjusted_poses(blank, tracked(cameras)) is None
    assert adjusted_poses(frames[:1], cameras[:1]) is None
