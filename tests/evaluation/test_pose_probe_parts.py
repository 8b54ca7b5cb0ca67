"""The steps of the pose probe: keypoints, lifting, absolute pose, summary."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from walls import (
    HEIGHT,
    WALLS,
    WIDTH,
    camera_at,
)

from gvtools.errors import ShapeError
from gvtools.evaluation.pose_probe import (
    Located,
    absolute_pose,
    angle_deg,
    center_distance,
    lift_keypoints,
    summarise,
)
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.features import Features, SiftMatcher, mutual_nearest

pytest_plugins = ("wall_fixtures",)


@pytest.mark.parametrize("place", [(100.5, 80.5), (100.3, 80.7), (60.0, 40.0)])
def test_sift_counts_from_the_corner_of_the_first_pixel(place: tuple[float, float]) -> None:
    y, x = np.mgrid[0:160, 0:200] + 0.5
    blob = 40 + 200 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 4**2))
    features = SiftMatcher().extract(np.repeat(blob[..., None], 3, axis=2).round().astype(np.uint8))
    assert np.abs(features.xy - place).max(axis=1).min() < 0.05
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, rtol=1e-5)


def test_a_picture_without_anything_has_no_features() -> None:
    assert len(SiftMatcher().extract(np.zeros((40, 60, 3), np.uint8))) == 0
    with pytest.raises(ShapeError, match="expected uint8"):
        SiftMatcher().extract(np.zeros((40, 60), np.uint8))
    with pytest.raises(ShapeError, match="expected \\(N, 2\\)"):
        Features(np.zeros((3, 2)), np.zeros((2, 8), np.float32), 4, 4)


def test_features_are_the_most_prominent_first(context: list[PosedPicture]) -> None:
    whole = SiftMatcher().extract(context[0].rgb)
    fewer = SiftMatcher(max_features=50).extract(context[0].rgb)
    np.testing.assert_array_equal(fewer.xy, whole.xy[:50])


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 40), st.integers(0, 40), st.integers(0, 10_000))
def test_mutual_nearest_is_what_a_plain_loop_finds(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = (rng.standard_normal((k, 4)).astype(np.float32) for k in (n, m))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    distance = np.linalg.norm(first[:, None].astype(np.float64) - second[None], axis=2)
    expected = []
    for i in range(n if m >= 2 else 0):
        j, other = np.argsort(distance[i])[:2]
        mutual = distance[:, j].argmin() == i
        if mutual and distance[i, j] <= 0.6 and distance[i, j] < 0.8 * distance[i, other]:
            expected.append((i, j))
    found = mutual_nearest(first, second, ratio=0.8, max_distance=0.6)
    assert [tuple(pair) for pair in found] == expected


def test_keypoints_are_lifted_onto_the_wall(context: list[PosedPicture]) -> None:
    picture = context[0]
    assert picture.depth is not None
    rng = np.random.default_rng(0)
    xy = rng.uniform([1, 1], [WIDTH - 1, HEIGHT - 1], (400, 2))
    points, ok = lift_keypoints(xy, picture.depth, picture.camera, edge=0.05)
    assert ok.mean() > 0.95
    points = points[ok]
    again, _ = picture.camera.project(points)
    np.testing.assert_allclose(again[0], xy[ok], atol=1e-6)
    # Of three walls that cross, the nearest along a ray is where all three are largest.
    off = np.stack([points @ n - offset for n, offset, _, _ in WALLS])
    assert np.percentile(np.abs(off.max(axis=0)), 95) < 1e-5


def test_keypoints_at_depth_edges_and_holes_are_left_out() -> None:
    camera = camera_at((0.0, 0.0, 0.0))
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth[:, 100:] = 1.0
    depth[50, 20] = 0
    depth[60, 20] = np.nan
    xy = np.array(
        [[99.9, 30.0], [90.0, 30.0], [20.4, 50.6], [21.2, 60.1], [0.1, 0.1], [319.9, 239.9]]
    )
    points, ok = lift_keypoints(xy, depth, camera, edge=0.05)
    assert ok.tolist() == [False, True, False, False, True, True]
    np.testing.assert_allclose(np.linalg.inv(camera.K[0]) @ [90, 30, 1] * 2, points[1])


def test_absolute_pose_of_exact_matches_with_skew_and_outliers() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-1, -1, 2], [1, 1, 5], (200, 3))
    camera = camera_at((0.1, 0.2, -0.3), turn=(5, -7, 20))
    K = camera.K.copy()
    K[0, 0, 1] = 15.0
    xy = dataclasses.replace(camera, K=K).project(points)[0][0]
    xy[:60] = rng.uniform([0, 0], [WIDTH, HEIGHT], (60, 2))
    pose = absolute_pose(xy, points, K[0], max_error=2.0)
    assert pose is not None
    truth = camera.cam_from_world[0]
    assert angle_deg(pose.cam_from_world[:3, :3], truth[:3, :3]) < 1e-4
    assert center_distance(pose.cam_from_world, truth) < 1e-5
    assert pose.inliers[60:].all() and pose.inliers[:60].sum() <= 2
    assert absolute_pose(xy[:3], points[:3], K[0], max_error=2.0) is None


@given(st.floats(1e-9, 179.9), st.integers(0, 1000))
def test_angle_between_orientations(degrees: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    first = Rotation.random(random_state=seed).as_matrix()
    second = Rotation.from_rotvec(axis * np.radians(degrees)).as_matrix() @ first
    assert angle_deg(first, second) == pytest.approx(degrees, rel=1e-5, abs=1e-12)


def found_at(name: str, rotation: float | None, center: float | None) -> Located:
    ok = rotation is not None
    return Located(
        name=name,
        status="located" if ok else "failed: 3 inliers of 90 matches, at least 25 are needed",
        cam_from_world=np.eye(4) if ok else None,
        keypoints=500,
        matches=90,
        inliers=60 if ok else 3,
        cells=30 if ok else 3,
        rival=0,
        residual=1.0 if ok else None,
        views=("c0",),
        rotation_error_deg=rotation,
        center_error=center,
        center_error_share=center,
    )


def test_a_summary_counts_failures_as_failures() -> None:
    found = [found_at("a", 1.0, 0.3), found_at("b", None, None), found_at("c", 3.0, 0.1)]
    summary = summarise(found)
    assert (summary.pictures, summary.located) == (3, 2)
    assert summary.success_share == pytest.approx(2 / 3)
    assert summary.failures == (("b", found[1].status),)
    assert summary.rotation_error_deg is not None and summary.center_error is not None
    assert summary.rotation_error_deg.n == 2
    assert summary.rotation_error_deg.median == pytest.approx(2)
    assert summary.center_error.rmse == pytest.approx(np.sqrt(0.05))
    # Share of all pictures below x degrees: 0 to 1, a third to 3, two thirds to 5.
    assert summary.rotation_auc[5.0] == pytest.approx((2 / 3 + 4 / 3) / 5, abs=2e-3)


def test_a_summary_without_support_has_no_figures() -> None:
    none = summarise([found_at("b", None, None)])
    assert none.success_share == 0
    assert none.rotation_error_deg is None and none.center_error is None and none.inliers is None
    assert none.rotation_auc[5.0] == 0
    nothing = summarise([])
    assert nothing.success_share is None and nothing.rotation_auc[5.0] is None
