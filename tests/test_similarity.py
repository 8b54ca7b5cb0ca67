from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from geoverse_models import rotation
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, concatenate, rigid_poses
from gvtools.errors import ShapeError
from gvtools.similarity import (
    COLLINEAR,
    SimilarityFit,
    align_depth_scale,
    align_poses,
    fit_similarity,
)
from gvtools.view_selection import covisible_views, evenly_spread, in_view, nearest_views

pytestmark = pytest.mark.filterwarnings("error")
SPACE = (1.0, 0.7, 0.4)
PLANE = (1.0, 0.7, 0.0)
LINE = (1.0, 0.0, 0.0)
CUBE = np.array(list(product((-1, 1), repeat=3)), np.float64)
# Every coordinate is a product of two of the cube's: as far apart, and uncorrelated with it.
UNRELATED = CUBE * np.roll(CUBE, 1, axis=1)


def spread(count: int, axes: tuple[float, float, float], *, seed: int = 0) -> np.ndarray:
    """Points about the origin, in an arbitrary orientation, with the spread along three axes."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * axes
    return (points - points.mean(0)) @ Rotation.random(rng=rng).as_matrix().T


def turn(seed: int = 1) -> np.ndarray:
    return Rotation.random(rng=np.random.default_rng(seed)).as_matrix()


@pytest.mark.parametrize("axes", [SPACE, PLANE])
def test_a_rigid_fit_agrees_with_scipy_and_keeps_the_scale(axes):
    source = 3 * spread(12, axes)
    target = source @ turn().T + 0.1 * np.random.default_rng(4).standard_normal((12, 3))
    fit = fit_similarity(source, target, with_scale=False)
    other, _ = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    assert fit.scale == 1
    np.testing.assert_allclose(fit.rotation, other.as_matrix(), atol=1e-7)


def test_large_offsets_keep_millimetres():
    source = np.random.default_rng(7).standard_normal((20, 3)) * 20
    target = 0.37 * source @ turn().T + [6.9e5, 5.3e6, 400.0]
    fit = fit_similarity(source, target)
    assert np.abs(fit.apply(source) - target).max() < 1e-8
    back = fit_similarity(target, source)
    assert np.abs(back.apply(target) - source).max() < 1e-7
    formula = back.scale * target @ back.rotation.T + back.translation
    assert np.abs(formula - source).max() < 1e-6


def test_shapes_and_values_are_checked():
    points = spread(12, SPACE)
    with pytest.raises(ShapeError, match=r"both \(N, 3\)"):
        fit_similarity(points, points[:-1])
    points[3, 1] = np.nan
    with pytest.raises(ShapeError, match="NaN"):
        fit_similarity(points, points)


def _depths(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    reference = rng.uniform(1, 5, (40, 50))
    return reference / 1.7 * np.exp(0.01 * rng.standard_normal(reference.shape)), reference


def test_a_scale_survives_forty_percent_of_wrong_pixels():
    depth, reference = _depths()
    wrong = np.random.default_rng(1).random(depth.shape) < 0.4
    depth[wrong] *= 1.6
    fit = align_depth_scale(depth, reference, valid=np.ones(depth.shape, bool))
    assert fit.ok
    assert fit.scale == pytest.approx(1.7, rel=2e-3)
    assert fit.inlier_share == pytest.approx((~wrong).mean(), abs=0.02)
    # The plain mean of ratios, for comparison, is far off.
    assert abs(np.mean(reference / depth) / 1.7 - 1) > 0.1


def test_only_common_finite_pixels_count():
    depth, reference = _depths()
    valid = np.ones(depth.shape, bool)
    valid[:10] = False
    depth[:10] *= 9
    depth[10, :3] = (np.nan, np.inf, 0)
    reference[11, :2] = (0, np.nan)
    confidence = np.ones(depth.shape)
    confidence[12, 0] = 0
    fit = align_depth_scale(depth, reference, valid=valid, confidence=confidence)
    assert fit.support == 30 * 50 - 6
    assert fit.scale == pytest.approx(1.7, rel=2e-3)


def test_confidence_decides_between_two_scales():
    reference = np.full((40, 50), 2.0)
    depth = np.where(np.arange(50) < 30, 1.0, 1.25) * np.ones((40, 1))
    confidence = np.where(np.arange(50) < 30, 0.1, 1.0) * np.ones((40, 1))
    valid = np.ones(depth.shape, bool)
    assert align_depth_scale(depth, reference, valid=valid).scale == pytest.approx(2.0)
    weighted = align_depth_scale(depth, reference, valid=valid, confidence=confidence)
    assert weighted.scale == pytest.approx(1.6)


def test_too_little_overlap_and_too_much_spread_are_refused():
    depth, reference = _depths()
    few = np.zeros(depth.shape, bool)
    few.ravel()[:199] = True
    fit = align_depth_scale(depth, reference, valid=few)
    assert not fit.ok and np.isnan(fit.scale) and "199 common pixels" in fit.status
    scattered = depth * np.random.default_rng(2).uniform(0.3, 3, depth.shape)
    fit = align_depth_scale(scattered, reference, valid=np.ones(depth.shape, bool))
    assert fit.status.startswith("unsupported: ") and np.isnan(fit.scale)


def test_poses_are_aligned_by_the_motion_of_their_world():
    turns = Rotation.random(6, random_state=0).as_matrix()
    poses = rigid_poses(turns, np.random.default_rng(0).normal(size=(6, 3)))
    motion = rigid_poses(Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix(), [3, -20, 5])
    np.testing.assert_allclose(align_poses(poses, poses @ motion), motion, atol=1e-12)


def is_degenerate(fit: SimilarityFit, reason: str) -> bool:
    numbers = [fit.scale, fit.rmse, *fit.rotation.ravel(), *fit.translation, *fit.residuals]
    return not fit.ok and reason in fit.status and bool(np.isnan(numbers).all())


@settings(max_examples=60, deadline=None)
@given(
    st.integers(-30, 30),
    st.integers(-30, 30),
    st.integers(3, 8),
    st.sampled_from([SPACE, PLANE]),
)
def test_any_units_give_the_similarity_between_them(first, second, count, axes):
    points, rotation = spread(count, axes, seed=count), turn()
    thickness = np.linalg.svd(points, compute_uv=False)
    assume(thickness[1] > 0.01 * thickness[0])
    shift = 10 * 10.0**second * np.random.default_rng(count).standard_normal(3)
    fit = fit_similarity(
        points * 10.0**first,
        points @ rotation.T * 10.0**second + shift,
    )
    assert fit.ok
    np.testing.assert_allclose(fit.translation, shift, atol=1e-12 * np.abs(shift).max())
    assert fit.scale * 10.0 ** (first - second) == pytest.approx(1, rel=1e-12)
    np.testing.assert_allclose(fit.rotation, rotation, atol=1e-11)
    assert fit.rmse <= 1e-12 * 10.0**second
    unit = 10.0**first
    rigid = fit_similarity(points * unit, points @ rotation.T * unit, with_scale=False)
    assert rigid.scale == 1
    np.testing.assert_allclose(rigid.rotation, rotation, atol=1e-11)


@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (spread(2, SPACE), "2 point pair(s)"),
        (spread(3, LINE), "collinear"),
        (np.repeat(spread(1, SPACE) + 0.3, 5, axis=0), "coincident"),
        (np.repeat(spread(2, SPACE), 4, axis=0), "collinear"),
    ],
)
def test_what_leaves_the_rotation_open_is_degenerate_in_any_unit(points, reason, unit):
    other = spread(len(points), SPACE, seed=5)
    assert is_degenerate(fit_similarity(points * unit, other), reason)
    assert is_degenerate(fit_similarity(other, points * unit), reason)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_the_limit_of_a_line_is_a_share_of_its_length(unit):
    along = np.linspace(-1, 1, 41)
    across = np.where(np.arange(41) % 2, 1.0, -1.0) * np.sqrt(np.mean(along**2))
    for share, ok in ((1.1 * COLLINEAR, True), (0.9 * COLLINEAR, False)):
        points = np.stack([along, share * across, 0 * along], 1)
        points -= points.mean(0)
        rotation = turn()
        fit = fit_similarity(points * unit, points @ rotation.T)
        assert fit.ok is ok
        if ok:
            np.testing.assert_allclose(fit.rotation, rotation, atol=1e-11)


def test_points_without_correlation_have_no_fit():
    assert is_degenerate(fit_similarity(CUBE[:0], CUBE[:0]), "0 point pair(s)")
    assert is_degenerate(fit_similarity(CUBE, UNRELATED), "correspond")


@pytest.mark.parametrize("with_scale", [True, False])
def test_a_mirror_image_is_flagged_or_degenerate_where_no_rotation_is_best(with_scale):
    assert is_degenerate(fit_similarity(CUBE, -CUBE, with_scale=with_scale), "mirror image")
    points = spread(8, SPACE)
    fit = fit_similarity(points, points * (1, 1, -1), with_scale=with_scale)
    assert fit.ok and fit.mirrored
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    flat = spread(8, SPACE) * (1, 1, 0)
    assert not fit_similarity(flat, flat * (-1, 1, 1), with_scale=with_scale).mirrored


@settings(max_examples=40, deadline=None)
@given(
    st.one_of(
        st.sampled_from([0.0, 1e-16, 1e-8, np.pi - 1e-8, np.pi - 1e-15, np.pi]), st.floats(0, np.pi)
    ),
    st.integers(0, 100),
    st.sampled_from([SPACE, PLANE]),
)
def test_rotations_near_none_and_near_a_half_turn_are_found(angle, seed, axes):
    axis = np.random.default_rng(seed).standard_normal(3)
    rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    points = spread(10, axes, seed=seed)
    fit = fit_similarity(points, points @ rotation.T)
    np.testing.assert_allclose(fit.rotation, rotation, atol=1e-12)


DEPTH = np.random.default_rng(0).uniform(1, 5, (20, 30))
ALL = np.ones(DEPTH.shape, bool)


@settings(max_examples=40, deadline=None)
@given(st.integers(-30, 30))
def test_depth_scales_of_any_size_are_found(power):
    fit = align_depth_scale(DEPTH, DEPTH * 10.0**power, valid=ALL)
    assert fit.ok
    assert fit.scale == pytest.approx(10.0**power, rel=1e-11)
    assert fit.inliers == fit.support == DEPTH.size
    assert fit.residual < 1e-9
    one = align_depth_scale([[2.0]], [[2 * 10.0**power]], valid=[[True]], min_support=1)
    assert one.scale == pytest.approx(10.0**power, rel=1e-11)


def looking(centre: tuple[float, float, float], angle: float, name: str) -> Cameras:
    axes = rotation((0, 1, 0), angle).T
    pose = rigid_poses(axes, -axes @ np.array(centre))
    return Cameras.pinhole(40, 30, focal=40.0, cam_from_world=pose, name=name)


def views(*cameras: Cameras) -> Cameras:
    return concatenate(list(cameras))


def nearest(context: Cameras, targets: Cameras, count: int) -> list[str]:
    return [context.names[row] for row in nearest_views(context, targets, count)]


def covisible(
    context: Cameras, target: Cameras, depth: np.ndarray, count: int, own: np.ndarray | None = None
) -> list[str]:
    """``own`` is the depth of the first view; the others have none."""
    depths = [own, *[None] * (len(context) - 1)]
    rows = covisible_views(context, target, depth, count=count, depths=depths)
    return [context.names[row] for row in rows]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_the_nearest_views_stand_and_look_like_the_targets(scale, shift):
    def place(x: float, angle: float, name: str) -> Cameras:
        return looking((scale * (x + shift), 0, 0), angle, name)

    context = views(
        place(0, 0, "left"),
        place(10, 0, "right"),
        place(1, np.pi, "behind"),
        place(4, 0, "middle"),
        place(1, 0.1, "beside"),
    )

    def chosen(count: int, *targets: Cameras) -> list[str]:
        return nearest(context, concatenate(list(targets)), count)

    near = place(1, 0, "target")
    assert chosen(1, near) == ["beside"]
    assert chosen(2, near) == ["beside", "left"]
    assert chosen(1, place(1, np.pi, "turned")) == ["behind"]
    assert chosen(1, place(9, 0, "target")) == ["right"]
    # The first serves all targets; each then has its own: not the three that are best for one.
    assert chosen(1, near, place(9.5, 0, "far")) == ["middle"]
    assert set(chosen(3, near, place(9.5, 0, "far"))) == {"middle", "beside", "right"}
    everything = chosen(9, near)
    assert sorted(everything) == sorted(context.names)
    assert everything[0] == "beside" and everything[-1] == "behind"


def wall(distance: float) -> np.ndarray:
    return np.full((30, 40), distance, np.float32)


def test_a_view_that_sees_the_target_comes_before_one_that_stands_nearer():
    target = looking((0, 0, 0), 0.0, "target")
    context = views(looking((0.1, 0, 0), 1.2, "turned away"), looking((0, 0, -2), 0.0, "behind it"))
    assert nearest(context, target, 1) == ["turned away"]
    assert covisible(context, target, wall(2.0)[None], 1) == ["behind it"]


def test_the_second_view_shows_what_the_first_does_not():
    target = looking((0, 0, 0), 0.0, "target")
    context = views(
        looking((-1, 0, 0), 0.0, "left"),
        looking((-1.05, 0, 0), 0.0, "left again"),
        looking((1.2, 0, 0), 0.0, "right"),
    )
    assert covisible(context, target, wall(2.0)[None], 2) == ["left", "right"]
    everything = covisible(context, target, wall(2.0)[None], 9)
    assert sorted(everything) == ["left", "left again", "right"]


def test_what_hides_behind_a_photographs_own_surface_is_not_seen_by_it():
    target = looking((0, 0, 0), 0.0, "target")
    near, far = looking((0.1, 0, 0), 0.0, "near"), looking((0.6, 0, 0), 0.0, "far")

    def chosen(own: np.ndarray | None) -> list[str]:
        return covisible(views(near, far), target, wall(2.0)[None], 1, own)

    assert chosen(None) == chosen(wall(2.0)) == chosen(0 * wall(1.0)) == ["near"]
    # A board before the camera.
    assert chosen(wall(0.5)) == ["far"]


def test_without_depth_the_nearest_stand_in():
    target = looking((0, 0, 0), 0.0, "target")
    context = views(looking((3, 0, 0), 0.0, "far"), looking((0.1, 0, 0), 0.0, "near"))
    for nothing in (0.0, np.nan, np.inf):
        depth = np.full((1, 30, 40), nothing, np.float32)
        assert covisible(context, target, depth, 1) == ["near"]


def test_points_behind_and_beside_a_camera_are_not_in_its_view():
    points = np.array([[0, 0, 1.0], [0, 0, -1.0], [0.6, 0, 1.0], [0.4, 0, 1.0]])
    cameras = views(looking((0, 0, 0), 0.0, "ahead"), looking((0, 0, 0), np.pi, "back"))
    assert in_view(cameras, points).tolist() == [
        [True, False, False, True],
        [False, True, False, False],
    ]


def test_few_of_many_are_spread_over_all():
    assert list(evenly_spread(range(10), 3)) == [0, 4, 8]
    assert list(evenly_spread(range(2), 3)) == [0, 1]
    assert list(evenly_spread([])) == []
