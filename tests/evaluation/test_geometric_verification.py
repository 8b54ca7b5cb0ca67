from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from consistency_scene import (
    HALF,
    SLANT,
    SQUARE,
    WALL,
    camera,
    moved,
    picture,
    real_pictures,
)

from gvtools.errors import ShapeError
from gvtools.evaluation.geometric_verification import (
    epipolar_distances,
    verify_geometry,
)

WIDTH, HEIGHT = 180, 135


@pytest.fixture(scope="module")
def views():
    """Four views along a bent path."""
    poses = [((-0.3 + 0.2 * i, 0.1 * (i % 2), 0.05 * i), (0, 2 * i - 3, i)) for i in range(4)]
    return [
        picture(camera(center, turn=turn, width=WIDTH, height=HEIGHT), f"view {i}")
        for i, (center, turn) in enumerate(poses)
    ]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return tmp_path_factory.mktemp("verification")


@pytest.fixture(scope="module")
def right(views, workspace):
    """The views at their true poses."""
    return verify_geometry(views, workspace=workspace)


def test_exact_pictures_fit_their_poses(right):
    assert right.ok and right.images == 4 and len(right.pairs) == 6
    assert (right.mean_verified or 0) > 160 and right.verified_share == 1
    assert right.epipolar < 0.1
    assert right.mean_reprojection < 0.15
    assert (right.epipolar_inlier_share or 0) > 0.99 and (right.triangulated_share or 0) > 0.99
    assert right.registered_share == 1 and right.unregistered == ()
    assert right.points > 280 and (right.mean_track_length or 0) > 2.5
    assert right.reprojection_limit == 0.05 * WIDTH


def test_points_lie_on_the_scenes_surfaces_and_poses_stay(right, views, workspace):
    model = pycolmap.Reconstruction(workspace / "model")
    assert model.num_points3D() == right.points
    for image in model.images.values():
        view = views[int(Path(image.name).stem)]
        np.testing.assert_allclose(
            image.cam_from_world().matrix(), view.camera.cam_from_world[0, :3], atol=1e-12
        )
        np.testing.assert_array_equal(image.camera.calibration_matrix(), view.camera.K[0])
    points = np.stack([point.xyz for point in model.points3D.values()])
    wall = np.abs(points[:, 2] - WALL - SLANT * points[:, 0])
    square = np.where(
        (np.abs(points[:, :2]) < HALF + 0.02).all(1), np.abs(points[:, 2] - SQUARE), 9
    )
    assert np.mean(np.minimum(wall, square) < 0.03) > 0.95


@pytest.mark.parametrize(
    ("turn", "shift"),
    [((0, 3, 0), (0, 0, 0)), ((3, 0, 0), (0, 0, 0)), ((0, 0, 0), (0.15, 0.08, 0))],
)
def test_a_wrong_pose_shows(right, views, turn, shift):
    wrong = verify_geometry([views[0], moved(views[1], turn=turn, shift=shift), *views[2:]])
    # What does not use the poses stays.
    assert wrong.mean_verified == right.mean_verified and wrong.mean_features == right.mean_features
    assert (wrong.mean_reprojection or 0) > 10 * (right.mean_reprojection or 1)
    assert (wrong.epipolar or 0) > 2 * (right.epipolar or 1)
    assert (wrong.epipolar_inlier_share or 1) < (right.epipolar_inlier_share or 0) - 0.05
    for before, after in zip(right.pairs, wrong.pairs, strict=True):
        assert (before.first, before.second) == (after.first, after.second)
        touched = "view 1" in (after.first, after.second)
        assert touched == (after.epipolar != before.epipolar)


def test_a_picture_of_something_else_is_named(views):
    other = picture(views[1].camera, "other", seed=9)
    result = verify_geometry([views[0], other, *views[2:]])
    assert result.unregistered == ("other",)
    assert result.verified_share == result.registered_share == 0.75
    assert all("other" not in (pair.first, pair.second) for pair in result.pairs)
    assert (result.mean_reprojection or 9) < 0.15


def test_masked_features_are_not_used(views, tmp_path):
    mask = np.broadcast_to(np.arange(WIDTH) < 90, (HEIGHT, WIDTH))
    result = verify_geometry([replace(views[0], mask=mask), views[1]], workspace=tmp_path)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        number = {image.name: image.image_id for image in database.read_all_images()}
        masked, whole = (database.read_keypoints(number[f"{i:06d}.png"]) for i in range(2))
    assert len(masked) > 50 and masked[:, 0].max() <= 98 < whole[:, 0].max()
    assert result.mean_features == (len(masked) + len(whole)) / 2
    assert result.pairs[0].verified <= len(masked)


def test_epipolar_distance_across_a_sideways_step_is_the_difference_in_height():
    first, second = camera((0, 0, 0)), camera((0.7, 0, 0))
    a = np.array([[10.0, 20.0], [90.0, 70.0]])
    b = a + np.array([[-30.0, 3.0], [4.0, -1.5]])
    np.testing.assert_allclose(epipolar_distances(first, second, (a, b)), [3.0, 1.5])


def test_a_camera_that_only_turns_has_no_epipolar_figure(views):
    x, y, z = views[0].camera.centers[0]
    turned = picture(camera((x, y, z), turn=(2, 4, 0), width=WIDTH, height=HEIGHT), "turned")
    result = verify_geometry([views[0], turned])
    assert result.pairs[0].verified > 100 and result.pairs[0].epipolar is None
    assert result.epipolar is None and result.epipolar_inlier_share is None
    assert result.status.endswith("verified matches, but none between cameras with two centres")
    assert result.points == 0 and result.triangulated_share == 0 == result.registered_share
    assert result.mean_reprojection is None and result.mean_track_length is None


def test_pictures_without_texture_give_a_status(views):
    blank = [replace(view, rgb=np.full_like(view.rgb, 120)) for view in views[:3]]
    result = verify_geometry(blank)
    assert result.status == (
        "empty: no pair of the 3 pictures (0 features) has 15 verified matches"
    )
    assert result.mean_verified == result.verified_share == result.registered_share == 0
    assert result.epipolar is None and result.mean_reprojection is None
    assert result.unregistered == ("view 0", "view 1", "view 2")


def test_too_few_pictures_give_a_status(views):
    for few in (views[:0], views[:1]):
        result = verify_geometry(few)
        assert result.status == f"empty: {len(few)} picture(s); at least 2 are needed"
        assert result.registered_share is None and result.mean_verified is None


def test_a_camera_with_skew_is_refused(views):
    K = views[0].camera.K.copy()
    K[:, 0, 1] = 2
    with pytest.raises(ShapeError, match="skew 2"):
        verify_geometry([replace(views[0], camera=replace(views[0].camera, K=K)), views[1]])


def test_equal_pictures_and_seed_give_equal_figures_and_print_nothing(right, views, capfd):
    level = pycolmap.logging.minloglevel
    assert verify_geometry(views) == right
    assert capfd.readouterr() == ("", "")
    assert pycolmap.logging.minloglevel == level


@pytest.mark.data
@pytest.mark.slow
def test_a_real_recording_fits_until_a_pose_is_wrong(shared):
    views = real_pictures(shared, slice(0, 9, 2))
    good = verify_geometry(views)
    bad = verify_geometry([*views[:2], moved(views[2], turn=(0, 2, 0)), *views[3:]])
    assert (good.mean_reprojection or 9) < 1.2 and (good.triangulated_share or 0) > 0.97
    assert (bad.mean_reprojection or 0) > 2 * (good.mean_reprojection or 9)
    assert (bad.epipolar_inlier_share or 1) < 0.8 * (good.epipolar_inlier_share or 0)
