from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, invert_rigid
from gvtools.completers.geoverse.objective import center_similarity
from gvtools.errors import DegenerateError, OptionError
from gvtools.similarity import COLLINEAR, SimilarityFit, align_depth_scale, fit_similarity
from gvtools.trajectories import focus_point, interpolate, look_at, orbit, spiral

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


def is_degenerate(fit: SimilarityFit, reason: str) -> bool:
    numbers = [fit.scale, fit.rmse, *fit.rotation.ravel(), *fit.translation, *fit.residuals]
    return not fit.ok and reason in fit.status and bool(np.isnan(numbers).all())


@settings(max_examples=60, deadline=None)
@given(
    st.integers(-30, 30),
    st.integers(-30, 30),
    st.integers(3, 8),
    st.sampled_from([SPACE, PLANE]),
    st.booleans(),
)
def test_any_units_give_the_similarity_between_them(first, second, count, axes, weighted):
    points, rotation = spread(count, axes, seed=count), turn()
    thickness = np.linalg.svd(points, compute_uv=False)
    assume(thickness[1] > 0.01 * thickness[0])
    fit = fit_similarity(
        points * 10.0**first,
        points @ rotation.T * 10.0**second,
        weights=np.ones(count) if weighted else None,
    )
    assert fit.ok
    assert fit.scale * 10.0 ** (first - second) == pytest.approx(1, rel=1e-12)
    np.testing.assert_allclose(fit.rotation, rotation, atol=1e-11)
    assert fit.rmse <= 1e-13 * 10.0**second
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
        (spread(9, LINE), "collinear"),
        (np.repeat(spread(1, SPACE) + 0.3, 5, axis=0), "coincident"),
        (np.repeat(spread(2, SPACE), 4, axis=0), "collinear"),
        (np.zeros((4, 3)), "coincident"),
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
    weighted = fit_similarity(CUBE, UNRELATED, weights=np.ones(8))
    assert is_degenerate(weighted, "correspond")


@pytest.mark.parametrize("with_scale", [True, False])
def test_a_mirror_image_is_flagged_or_degenerate_where_no_rotation_is_best(with_scale):
    assert is_degenerate(fit_similarity(CUBE, -CUBE, with_scale=with_scale), "mirror image")
    points = spread(8, SPACE)
    fit = fit_similarity(points, points * (1, 1, -1), with_scale=with_scale)
    assert fit.ok and fit.mirrored
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    flat = spread(8, SPACE) * (1, 1, 0)
    assert not fit_similarity(flat, flat * (-1, 1, 1), with_scale=with_scale).mirrored


def test_rows_of_weight_zero_may_hold_anything_finite():
    points, rotation = spread(6, SPACE), turn()
    clean = fit_similarity(points, points @ rotation.T, weights=np.ones(6))
    for far in (1e20, 1e30):
        source = np.concatenate([[[far, 0, -far]], points])
        target = np.concatenate([[[0, far, far]], points @ rotation.T])
        fit = fit_similarity(source, target, weights=[0, 1, 1, 1, 1, 1, 1])
        assert (fit.scale, fit.rmse) == (clean.scale, clean.rmse)
        np.testing.assert_array_equal(fit.rotation, clean.rotation)


@pytest.mark.parametrize("weight", [1e-30, 1e30])
def test_weights_count_by_their_ratios_alone(weight):
    rng = np.random.default_rng(0)
    points = spread(6, SPACE)
    target = points @ turn().T + 0.01 * rng.standard_normal((6, 3))
    share = np.array([1, 1, 0.5, 0.25, 1, 1])
    fit, plain = (fit_similarity(points, target, weights=w) for w in (share * weight, share))
    assert fit.scale == pytest.approx(plain.scale, rel=1e-12)
    assert fit.rmse == pytest.approx(plain.rmse, rel=1e-12)


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


@settings(max_examples=40, deadline=None)
@given(st.integers(-30, 30), st.integers(-30, 30), st.integers(2, 6))
def test_the_scale_of_centres_is_found_in_any_unit(first, second, count):
    points = spread(count, SPACE, seed=count)
    predicted = torch.from_numpy(points * 10.0**first)[None]
    reference = torch.from_numpy(points @ turn().T * 10.0**second)[None]
    fit = center_similarity(predicted, reference)
    assert fit.status == ("aligned",)
    wanted = (reference.norm() / predicted.norm()).item()
    assert fit.scale.item() == pytest.approx(wanted, rel=1e-9)


DEPTH = np.random.default_rng(0).uniform(1, 5, (20, 30))
ALL = np.ones(DEPTH.shape, bool)


@settings(max_examples=40, deadline=None)
@given(st.integers(-30, 30))
def test_depth_scales_of_any_size_are_found(power):
    fit = align_depth_scale(DEPTH, DEPTH * 10.0**power, valid=ALL)
    assert fit.ok
    assert fit.scale == pytest.approx(10.0**power, rel=1e-11)
    assert fit.inliers == DEPTH.size


@pytest.mark.parametrize("weight", [1e-30, 1e30])
def test_confidences_count_by_their_ratios_alone(weight):
    fit = align_depth_scale(DEPTH, DEPTH * 2, valid=ALL, confidence=np.full(DEPTH.shape, weight))
    assert fit.scale == pytest.approx(2, rel=1e-9)


@pytest.mark.parametrize("least", [0, 1, 200])
@pytest.mark.parametrize(
    ("depth", "valid"), [(DEPTH, ~ALL), (DEPTH * np.nan, ALL), (-DEPTH, ALL), (DEPTH[:0], ALL[:0])]
)
def test_no_common_pixel_has_no_scale(depth, valid, least):
    reference = np.abs(np.nan_to_num(depth)) + 1
    fit = align_depth_scale(depth, reference, valid=valid, min_support=least)
    assert fit.status.startswith("unsupported: 0 common pixels")
    assert np.isnan(fit.scale) and fit.support == 0


def test_constant_depth_and_one_pixel_have_a_scale_where_that_is_enough():
    assert align_depth_scale(ALL * 2.0, ALL * 6.0, valid=ALL).scale == pytest.approx(3, rel=1e-12)
    one = align_depth_scale([[2.0]], [[6.0]], valid=[[True]], min_support=1)
    assert one.scale == pytest.approx(3, rel=1e-12)


MAKERS: tuple[Callable[..., Cameras], ...] = (interpolate, orbit, spiral)


def keys(centers: Any, turns: Any = None) -> Cameras:
    """Cameras at centres (V, 3) with rotation vectors (V, 3), world from camera."""
    count = len(centers)
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, 3] = centers
    if turns is not None:
        pose[:, :3, :3] = Rotation.from_rotvec(np.asarray(turns, np.float64)).as_matrix()
    K = np.tile(np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), (count, 1, 1))
    return Cameras(K, invert_rigid(pose), np.full(count, 64), np.full(count, 48), ())


def arc(unit: float = 1.0) -> Cameras:
    t = np.linspace(0, 1.5, 7)
    centers = np.stack([np.cos(t), np.sin(t), 0.3 * t**2], 1)
    return keys(unit * centers, np.stack([0.2 * t, t, 0 * t], 1))


@settings(max_examples=30, deadline=None)
@given(st.integers(-29, 29))
def test_paths_are_those_of_the_scene_in_any_unit(power):
    unit = 10.0**power
    for make in MAKERS:
        path, plain = make(arc(unit), 5), make(arc(), 5)
        np.testing.assert_allclose(path.centers / unit, plain.centers, atol=1e-9)
        turns = path.cam_from_world[:, :3, :3], plain.cam_from_world[:, :3, :3]
        np.testing.assert_allclose(*turns, atol=1e-9)
    np.testing.assert_allclose(focus_point(arc(unit)) / unit, focus_point(arc()), atol=1e-9)


@pytest.mark.parametrize("gap", [0.0, 1e-12, 9e-10, 1.1e-9])
@pytest.mark.parametrize("where", ["first", "middle", "last"])
def test_keys_that_all_but_repeat_another_do_no_harm(gap, where):
    rows = {"first": (0, gap, 1, 2), "middle": (0, 1, 1 + gap, 2), "last": (0, 1, 2, 2 + gap)}
    path = interpolate(keys([(x, 0, 0) for x in rows[where]]), 5).centers
    np.testing.assert_allclose(path[:, 0], np.linspace(0, 2, 5), atol=3e-8)
    np.testing.assert_array_equal(path[:, 1:], 0)


@pytest.mark.parametrize("noise", [0.0, 1e-17, 1e-14])
@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_a_turn_on_the_spot_counts_though_centres_differ_by_rounding(noise, offset):
    """Three keys turn in place, the fourth moves: all of them lie on the path."""
    centers = [(offset + x, 0, 0) for x in (0, noise, 2 * noise, 3 * noise, 1)]
    turns = [(0, angle, 0) for angle in (0, 0.5, 1, 1.5, 1.5)]
    path = interpolate(keys(centers, turns), 401)
    at_rest = path.centers[:, 0] - offset < 1e-6
    angles = Rotation.from_matrix(path.world_from_cam[:, :3, :3]).as_rotvec()[:, 1]
    assert angles[at_rest].max() == pytest.approx(1.5, abs=0.01)
    assert 0.4 < at_rest.mean() < 0.8


@settings(max_examples=40, deadline=None)
@given(
    st.one_of(
        st.sampled_from([0.0, 1e-16, 1e-8, np.pi - 1e-8, np.pi - 1e-15, np.pi]), st.floats(0, np.pi)
    ),
    st.integers(0, 50),
)
def test_the_middle_of_any_turn_is_half_of_it(angle, seed):
    axis = np.random.default_rng(seed).standard_normal(3)
    axis /= np.linalg.norm(axis)
    path = interpolate(keys([(0, 0, 0), (1, 0, 0)], [(0, 0, 0), angle * axis]), 3)
    half = Rotation.from_matrix(path.world_from_cam[1, :3, :3]).as_rotvec()
    # A half turn may go either way about its axis.
    gap = min(np.abs(half - 0.5 * angle * axis).max(), np.abs(half + 0.5 * angle * axis).max())
    assert gap < 1e-12
    assert angle >= np.pi - 1e-12 or np.abs(half - 0.5 * angle * axis).max() < 1e-12


def test_a_point_to_look_at_has_to_differ_from_the_centre_beyond_rounding():
    for center, target in (((0, 0, 0), (0, 0, 0)), ((0, 0, 1e9), (0, 0, 1e9 + 1e-4))):
        with pytest.raises(DegenerateError, match="lies on the point"):
            look_at([center], target, up=(0, 1, 0))
    with pytest.raises(OptionError, match="up"):
        look_at([(0, 0, 0)], (0, 0, 1), up=(0, 0, 0))
    near = look_at([(0, 0, 0)], (0, 0, 1e-29), up=(0, -1, 0))[0]
    np.testing.assert_array_equal(near, np.eye(4))


@pytest.mark.parametrize("angle", [1e-1, 1e-2, 1e-3])
def test_the_focus_of_nearly_parallel_axes_is_found_or_refused(angle):
    meeting = focus_point(keys([(0, 0, 0), (1, 0, 0)], [(0, 0, 0), (0, -angle, 0)]))
    np.testing.assert_allclose(meeting * np.tan(angle), (0, 0, 1), atol=1e-9)
    with pytest.raises(DegenerateError, match="parallel"):
        focus_point(keys([(0, 0, 0), (1, 0, 0)], [(0, 0, 0), (0, -1e-4, 0)]))
