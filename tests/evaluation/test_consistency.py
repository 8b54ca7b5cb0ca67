from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
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
from gvtools.evaluation.posed_picture import (
    PosedPicture,
    Seen,
    correspond,
    depth_reprojection,
    depth_reprojection_of_views,
)

FIGURES = ("mean_pixels", "median_pixels", "mean_relative_depth", "median_relative_depth")
SHARES = ("covisible_share", "occluded_share", "contradicting_share", "unknown_share")


@pytest.fixture(scope="module")
def pair():
    """Two views whose parallax hides and uncovers parts of the wall."""
    return (
        picture(camera((-0.3, 0.05, 0), turn=(1, -4, 2)), "left"),
        picture(camera((0.4, -0.1, 0.2), turn=(-2, 6, -3), width=200, height=140), "right"),
    )


def _flat(depth: float, *, x: float = 0.0, measured: float | None = None) -> PosedPicture:
    """A wall square to the camera, whose depth is given as another than it is."""
    at = camera((x, 0, 0))
    size = int(at.height[0]), int(at.width[0])
    rgb = np.zeros((*size, 3), np.uint8)
    return PosedPicture("flat", at, rgb, np.full(size, measured or depth, np.float32))


def test_exact_depth_of_a_plane_leaves_no_error():
    first = picture(camera((-0.3, 0, 0)), "left", square=False)
    second = picture(camera((0.4, 0.1, 0.3), turn=(3, 8, -5)), "right", square=False)
    result = depth_reprojection(first, second)
    assert result.ok and (result.first, result.second) == ("left", "right")
    assert result.known == first.rgb[..., 0].size and 0 < result.inside < result.known
    assert result.covisible == result.inside
    assert result.mean_pixels < 1e-3
    assert result.mean_relative_depth < 1e-5
    assert [getattr(result, name) for name in SHARES] == [1, 0, 0, 0]


@pytest.mark.parametrize("scale", [0.97, 1.03])
def test_a_wrong_depth_scale_gives_its_closed_form(scale):
    distance, baseline = 2.5, 0.4
    first = _flat(distance)
    second = _flat(distance, x=baseline, measured=scale * distance)
    result = depth_reprojection(first, second)
    focal = first.camera.K[0, 0, 0]
    # q's ray at depth s Z comes back to f X' / (s Z), X' = b + s (X - b): off by f b (1 - s) / s Z.
    pixels = focal * baseline * abs(1 - scale) / (scale * distance)
    relative = abs(1 / scale - 1)
    expected = pytest.approx([pixels, pixels, relative, relative], rel=1e-5)
    assert [getattr(result, name) for name in FIGURES] == expected


def test_a_scale_beyond_the_occlusion_limit_shows_in_the_shares():
    near = depth_reprojection(_flat(2.0), _flat(2.0, x=0.1, measured=1.8))
    far = depth_reprojection(_flat(2.0), _flat(2.0, x=0.1, measured=2.2))
    assert near.occluded_share == 1 and far.contradicting_share == 1


def test_pixels_are_classified_as_the_scenes_geometry_says(pair):
    first, second = pair
    found = correspond(first, second)
    rotation, eye = first.camera.cam_from_world[0, :3, :3], first.camera.centers[0]
    rays = first.camera.rays()[found.rows, found.columns] @ rotation
    points = eye + first.depth[found.rows, found.columns, None] * rays
    (xy,), (z,) = second.camera.project(points)
    inside = ((xy >= 0) & (xy < (200, 140))).all(-1)
    np.testing.assert_allclose(found.z, z, rtol=1e-9)
    np.testing.assert_allclose(found.xy[inside], xy[inside], atol=1e-6)
    assert (found.seen[~inside] == Seen.OUTSIDE).all() and np.isnan(found.xy[~inside]).all()

    # Where the ray from second's centre to the point meets the plane of the square, beyond whose
    # rim (2 pixels aside) it is plain what is seen.
    center = second.camera.centers[0]
    along = (SQUARE - center[2]) / (points[:, 2] - center[2])
    rim = np.abs((center + along[:, None] * (points - center))[:, :2]).max(-1)
    on_square = np.abs(points[:, 2] - SQUARE) < 1e-3
    hidden = inside & ~on_square & (rim < HALF - 0.03)
    plain = inside & (on_square & (rim < HALF - 0.03) | ~on_square & (rim > HALF + 0.03))
    assert hidden.sum() > 100 and plain.sum() > 5000
    assert (found.seen[hidden] == Seen.OCCLUDED).all()
    assert (found.seen[plain] == Seen.COVISIBLE).all()


def test_what_floats_in_front_contradicts(pair):
    first, second = pair
    depth = first.depth.copy()
    depth[50:70, 130:150] *= 0.5
    clean, dirty = (correspond(replace(first, depth=d), second) for d in (first.depth, depth))
    patch = np.zeros(depth.shape, bool)
    patch[50:70, 130:150] = True
    floats = patch[dirty.rows, dirty.columns] & (dirty.seen != Seen.OUTSIDE)
    assert floats.sum() > 200
    assert (dirty.seen[floats] == Seen.CONTRADICTING).all()
    assert (dirty.seen == clean.seen)[~patch[dirty.rows, dirty.columns]].all()


def test_masked_and_missing_depth_is_not_known(pair):
    first, second = pair
    mask = np.zeros(first.depth.shape, bool)
    mask[10:30, 40:90] = True
    assert depth_reprojection(replace(first, mask=mask), second).known == 20 * 50
    bad = first.depth.copy()
    bad[0, :4] = np.nan, np.inf, -1, 0
    assert depth_reprojection(replace(first, depth=bad), second).known == bad.size - 4

    whole = depth_reprojection(first, second)
    hidden = replace(second, mask=np.arange(200)[None, :] < np.full((140, 1), 100))
    half = depth_reprojection(first, hidden)
    assert half.inside == whole.inside and 0 < half.covisible < whole.covisible
    assert sum(getattr(half, name) for name in SHARES) == pytest.approx(1)
    assert half.unknown_share == pytest.approx(
        np.mean(correspond(first, second).xy[:, 0] >= 100) * half.known / half.inside
    )


def test_views_without_common_surface_give_no_figure(pair):
    first, second = pair
    away = moved(second, turn=(0, 180, 0))
    for views, reason, unknown in (
        ((first, away), "nothing of left falls inside right", None),
        ((replace(first, depth=None), second), "left has no pixel with depth", None),
        ((first, replace(second, depth=None)), "right has no pixel with depth", 1),
        ((_flat(2.0), _flat(2.0, x=0.1, measured=1.8)), "flat and flat see no common surface", 0),
    ):
        result = depth_reprojection(*views)
        assert result.status == f"empty: {reason}" and not result.ok
        assert result.covisible == 0 and result.unknown_share == unknown
        assert all(getattr(result, name) is None for name in FIGURES)


def test_many_views_weigh_by_pixels_and_name_the_pairs_without_overlap(pair):
    away = replace(moved(pair[1], turn=(0, 180, 0)), name="away")
    off = replace(moved(pair[1], turn=(0, 2, 0), shift=(0.1, 0, 0)), name="off")
    path = [pair[0], off, pair[1], away]
    views = depth_reprojection_of_views(path)
    names = [(p.first, p.second) for p in views.pairs]
    assert names == [("left", "off"), ("off", "right"), ("right", "away")]
    assert views.status == "measured" and views.without_overlap == (("right", "away"),)
    found = [p for p in views.pairs if p.ok]
    assert views.covisible == sum(p.covisible for p in found)
    for name in FIGURES[::2]:
        total = sum(getattr(p, name) * p.covisible for p in found)
        assert getattr(views, name) == pytest.approx(total / views.covisible)
    pixels, relative = [], []
    for first, second in pairwise(path):
        both = correspond(first, second)
        on = both.seen == Seen.COVISIBLE
        pixels.append(np.linalg.norm(both.back - both.start, axis=1)[on])
        relative.append(np.abs(both.z[on] / both.depth[on] - 1))
    for value, spread in ((views.median_pixels, pixels), (views.median_relative_depth, relative)):
        assert value is not None and np.mean(np.concatenate(spread) < value) == pytest.approx(
            0.5, abs=0.005
        )
    assert sum(getattr(views, name) for name in SHARES) == pytest.approx(1)
    assert all(type(getattr(views, name)) is float for name in (*FIGURES, *SHARES))


def test_too_few_views_give_a_status(pair):
    for views in ([], [pair[0]]):
        result = depth_reprojection_of_views(views)
        assert result.status == f"empty: {len(views)} view(s); at least 2 are needed"
        assert result.mean_pixels is None and result.covisible_share is None
    apart = depth_reprojection_of_views([pair[0], moved(pair[1], turn=(0, 180, 0))])
    assert apart.status == "empty: none of the 1 pairs has a co-visible pixel"
    assert apart.median_pixels is None and len(apart.without_overlap) == 1


@pytest.mark.data
def test_a_real_recording_agrees_until_a_pose_is_wrong(shared):
    first, second = real_pictures(shared, slice(0, 3, 2))
    good = depth_reprojection(first, second)
    bad = depth_reprojection(first, moved(second, turn=(0, 2, 0)))
    assert good.median_relative_depth < 0.01
    assert (good.covisible_share or 0) > 0.85
    assert (bad.median_relative_depth or 0) > 3 * good.median_relative_depth
    assert (bad.contradicting_share or 0) > 10 * (good.contradicting_share or 1)


WIDTH, HEIGHT = 180, 135
# One of the views by a wrong pose.
WRONG = [((0, 3, 0), (0, 0, 0)), ((3, 0, 0), (0, 0, 0)), ((0, 0, 0), (0.15, 0.08, 0))]


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


@pytest.mark.parametrize(("turn", "shift"), WRONG)
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


def test_too_few_pictures_or_none_with_texture_give_a_status(views):
    blank = [replace(view, rgb=np.full_like(view.rgb, 120)) for view in views[:3]]
    nothing = "no pair of the 3 pictures (0 features) has 15 verified matches"
    few = "picture(s); at least 2 are needed"
    for given, reason, share in ((blank, nothing, 0), ([], f"0 {few}", None),
                                 (views[:1], f"1 {few}", None)):  # fmt: skip
        result = verify_geometry(given)
        assert result.status == f"empty: {reason}"
        assert result.mean_verified == result.verified_share == result.registered_share == share
        assert result.epipolar is None and result.mean_reprojection is None
        assert result.unregistered == tuple(view.name for view in given)


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
