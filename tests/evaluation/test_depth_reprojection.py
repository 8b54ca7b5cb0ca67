from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from consistency_scene import HALF, SQUARE, camera, moved, picture, real_pictures

from gvtools.evaluation.depth_reprojection import (
    depth_reprojection,
    depth_reprojection_of_views,
)
from gvtools.evaluation.posed_picture import PosedPicture, Seen, correspond

FIGURES = (
    "mean_pixels",
    "median_pixels",
    "mean_relative_depth",
    "median_relative_depth",
)
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
    assert result.mean_pixels == pytest.approx(pixels, rel=1e-5)
    assert result.median_pixels == pytest.approx(pixels, rel=1e-5)
    assert result.mean_relative_depth == pytest.approx(abs(1 / scale - 1), rel=1e-5)
    assert result.median_relative_depth == pytest.approx(abs(1 / scale - 1), rel=1e-5)


def test_a_scale_beyond_the_occlusion_limit_shows_in_the_shares():
    near = depth_reprojection(_flat(2.0), _flat(2.0, x=0.1, measured=1.8))
    far = depth_reprojection(_flat(2.0), _flat(2.0, x=0.1, measured=2.2))
    assert near.occluded_share == 1 and far.contradicting_share == 1
    assert all(getattr(result, name) is None for result in (near, far) for name in FIGURES)
    assert near.status == "empty: flat and flat see no common surface"


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
    blind = replace(second, depth=None)
    for result, reason in (
        (depth_reprojection(first, away), "nothing of left falls inside right"),
        (depth_reprojection(replace(first, depth=None), second), "left has no pixel with depth"),
        (depth_reprojection(first, blind), "right has no pixel with depth"),
    ):
        assert result.status == f"empty: {reason}" and not result.ok
        assert result.covisible == 0
        assert all(getattr(result, name) is None for name in FIGURES)
    assert depth_reprojection(first, away).covisible_share is None
    assert depth_reprojection(first, blind).unknown_share == 1


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
    for name in ("mean_pixels", "mean_relative_depth"):
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
