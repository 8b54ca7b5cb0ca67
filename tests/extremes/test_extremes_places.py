"""Scenes of every size and place: a change of unit or of the world's zero is no change of picture.

A power of two is exact in floating point, so every image has to be the same to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import SIZE, camera, focal, plane_view, points
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, check_usable, rigid_poses
from gvtools.errors import OptionError, ShapeError
from gvtools.evaluation.feature_consistency import feature_consistency
from gvtools.evaluation.images import image_figures, psnr, ssim
from gvtools.evaluation.posed_picture import PosedPicture, depth_reprojection
from gvtools.evaluation.statistics import mean_interval
from gvtools.evaluation.trajectories import (
    AUC_BINS,
    absolute_errors,
    area_under_recall,
    pose_auc,
    relative_errors,
)
from gvtools.guidance import Guidance
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.store.voxel_index import VOXEL_RANGE, rounded_origin

IMAGES = ("rgb", "depth", "valid", "confidence", "generated")
# Off the grid of voxels: which side of a border a wall falls on is no matter of scale.
SQUARE, WALL, VOXEL = 2.013, 4.037, 0.0207
CENTERS = ((0, 0, 0), (0.3, 0, 0), (0.02, 0.01, 0), (-0.4, 0.1, 0.2), (0.6, 0, 0))
BACKENDS = ("cpu", "torch", "nearest", "open3d")


def square_before_wall(
    scale: float, *, offset: ArrayLike = (0, 0, 0)
) -> tuple[SpatialMemory, list[FuseReport]]:
    """Five views in three rounds, the last one generated; lengths are times ``scale``."""
    offset = np.asarray(offset, np.float64)
    memory = SpatialMemory(VOXEL * scale, origin=offset)
    reports = []
    for i, place in enumerate(CENTERS):
        center = np.asarray(place, np.float64)
        source = camera(**SIZE, focal=60, center=offset + scale * center)
        at_square = center[:2] + source.rays()[..., :2] * (SQUARE - center[2])
        square = (abs(at_square) <= 0.41).all(-1)
        depth = (np.where(square, SQUARE, WALL) - center[2]) * scale
        rgb = np.where(square[..., None], (255, 40 * i, 0), (0, 40 * i, 255)).astype(np.uint8)
        generated = i == len(CENTERS) - 1
        depth = depth.astype(np.float32)
        reports.append(memory.observe(rgb, depth, source, round=i // 2, generated=generated))
    return memory, reports


def target(scale: float, offset: ArrayLike = (0, 0, 0)) -> Cameras:
    """A turned camera between the views of ``square_before_wall``."""
    center = np.asarray(offset, np.float64) + scale * np.array((0.1, 0.05, 0.3))
    return camera(**SIZE, focal=60, center=center, rotation=(0, 0.05, 0.02))


def share_that_differs(one: Guidance, two: Guidance, *, scale: float = 1.0) -> float:
    """The share of pixels that differ by more than 1e-4, depths of ``two`` times ``scale``."""
    off = np.zeros(one.valid.shape, bool)
    for name in IMAGES:
        a = np.asarray(getattr(one, name), np.float64)
        b = np.asarray(getattr(two, name), np.float64)
        a = a / scale if name == "depth" else a
        off |= ~np.isclose(a, b, rtol=1e-4, atol=1e-4).reshape(*off.shape, -1).all(-1)
    return float(off.mean())


@pytest.fixture(scope="module")
def home():
    memory, reports = square_before_wall(1.0)
    return memory, reports, {b: _seen(memory, 1.0, backend=b) for b in BACKENDS}


def _seen(memory, scale, *, offset=(0, 0, 0), backend="cpu"):
    return memory.project(target(scale, offset), options=SplatOptions(backend=backend))


@settings(max_examples=25, deadline=None)
@given(power=st.integers(-70, 80))
def test_a_power_of_two_changes_no_bit(power, home):
    scale = 2.0**power
    memory, reports = square_before_wall(scale)
    assert reports == home[1]
    np.testing.assert_array_equal(memory.positions, home[0].positions * scale)
    np.testing.assert_array_equal(memory.confidence, home[0].confidence)
    for backend in ("cpu", "nearest"):
        seen, expected = _seen(memory, scale, backend=backend), home[2][backend]
        for name in IMAGES:
            factor = np.float32(scale if name == "depth" else 1)
            np.testing.assert_array_equal(getattr(seen, name), getattr(expected, name) * factor)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("power", [-60, 32, 70])
def test_every_back_end_is_free_of_units(power, backend, home):
    scale = 2.0**power
    seen = _seen(square_before_wall(scale)[0], scale, backend=backend)
    assert share_that_differs(seen, home[2][backend], scale=scale) == 0


@pytest.mark.parametrize("far", [1e3, 1e7])
@pytest.mark.parametrize(("scale", "backends"), [(0.03, ("cpu",)), (1e3, BACKENDS)])
def test_utm_coordinates_change_no_picture(scale, backends, far, home):
    offset = np.array((far, -far, far / 3)) + 0.4
    memory, reports = square_before_wall(scale, offset=offset)
    assert [r.points for r in reports] == [r.points for r in home[1]]
    apart, _ = cKDTree((memory.positions - offset) / scale).query(home[0].positions)
    assert (apart > 1e-6).mean() < 1e-3
    for backend in backends:
        seen = _seen(memory, scale, offset=offset, backend=backend)
        assert share_that_differs(seen, home[2][backend], scale=scale) < 1e-3


@pytest.mark.parametrize("far", [1e3, 2.0**20, 2.0**22, 2.0**23 - 200])
def test_a_point_is_held_to_half_a_step_of_float32_as_far_as_voxels_go(far):
    """Positions in voxels: the step is a sixteenth of one at 2²⁰ and a half at the end."""
    rng = np.random.default_rng(1)
    where = rng.uniform(-100, 100, (300, 3)) + np.array((far, -far, 0))
    memory = SpatialMemory(1.0)
    report = memory.fuse(points(where, spacing=1.0), round=0)
    assert report.out_of_reach == 0
    assert len(memory) > 295
    apart, _ = cKDTree(where).query(memory.positions)
    single = np.abs(memory.positions).max(axis=1).astype(np.float32)
    lone = report.added - report.merged
    assert (np.sort(apart / np.spacing(single))[:lone] <= np.sqrt(0.75)).all()


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest"])
def test_the_ends_of_the_range_of_voxels_hold(end, backend):
    voxel = VOXEL_RANGE[end]
    source = camera(width=32, height=24, focal=4000)
    memory = SpatialMemory(voxel)
    depth = 4000 * voxel
    assert memory.fuse(plane_view(source, depth), round=0).out_of_reach == 0
    seen = memory.project(source, options=SplatOptions(backend=backend))
    assert seen.coverage > 0.2
    np.testing.assert_allclose(seen.depth[seen.valid] / depth, 1, rtol=1e-5)
    color = np.broadcast_to((200, 100, 50), seen.rgb.shape)
    np.testing.assert_allclose(seen.rgb[seen.valid] * 255, color[seen.valid], rtol=1e-5)


def test_an_origin_where_float64_is_coarser_than_voxels_is_refused():
    SpatialMemory(0.005, origin=(1e7, 0, 0))
    with pytest.raises(OptionError, match="move the scene nearer to 0 or take an edge of") as e:
        SpatialMemory(2e-8, origin=(0, -1e7, 0))
    assert "\n" not in str(e.value)


def test_an_origin_in_whole_units_stays_where_it_suffices():
    middle = np.array((512345.6, -12.3, 0.45))
    for voxel in (1e-5, 0.005, 3.0):
        np.testing.assert_array_equal(rounded_origin(middle, voxel), np.rint(middle))
    for voxel in (1e-6, 1e-8):
        left = np.abs(rounded_origin(middle, voxel) - middle)
        assert (np.spacing(left.astype(np.float32)) <= voxel / 64).all()


LENSES = (1e-2, 1.0, 60.0, 170.0, 179.9)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    degrees=st.sampled_from(LENSES),
    power=st.integers(-6, 6),
    far=st.sampled_from([0.0, 1e3, 1e7]),
)
def test_rays_and_projection_are_inverse(seed, degrees, power, far):
    """To 1e-9 pixels beside the origin; far away, to what float64 leaves of a pixel there."""
    rng = np.random.default_rng(seed)
    scale = 10.0**power
    center = scale * rng.normal(0, 1, 3) + far * rng.uniform(-1, 1, 3)
    one = camera(**SIZE, focal=focal(degrees), center=center, rotation=rng.normal(0, 1, 3))
    z = scale * 10 ** rng.uniform(-2, 2, (SIZE["height"], SIZE["width"], 1))
    world = (z * one.rays()) @ one.world_from_cam[0, :3, :3].T + one.centers[0]
    xy, depth = one.project(world.reshape(-1, 3))
    rows, columns = np.mgrid[: SIZE["height"], : SIZE["width"]]
    expected = np.stack([columns.ravel(), rows.ravel()], 1) + 0.5
    step = np.spacing(max(far, np.abs(world).max()))
    sight = np.abs(one.rays()).max(-1).ravel()
    off = np.abs(xy[0] - expected).max(axis=1)
    tolerance = 1e-9 + 16 * focal(degrees) * sight * step / z.ravel()
    seen = depth[0] > 0
    assert (off[seen] <= tolerance[seen]).all()
    assert (np.abs(depth[0] - z.ravel()) <= 16 * step * sight + 1e-12 * z.ravel()).all()
    # Only a depth below the rounding of the place may fall behind the camera.
    assert (z.ravel()[~seen] <= 16 * step * sight[~seen]).all()


@pytest.mark.parametrize("degrees", LENSES)
@pytest.mark.parametrize("far", [0.0, 1e7])
def test_pluecker_rays_are_unit_and_pass_through_the_centre(degrees, far):
    center = np.array((far + 1, 2 - far, 0.3 * far + 3))
    one = camera(**SIZE, focal=focal(degrees), center=center, rotation=(0.3, -0.2, 0.1))
    ray = one.plucker()
    direction, moment = ray[..., :3], ray[..., 3:]
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, rtol=1e-14)
    np.testing.assert_allclose(
        moment, np.cross(center, direction), atol=1e-14 * (1 + np.abs(center).max())
    )


@pytest.mark.parametrize(
    ("name", "entry", "value", "said"),
    [
        ("K", (0, 0, 2), np.nan, "NaN or infinity"),
        ("cam_from_world", (0, 1, 3), np.inf, "NaN or infinity"),
        ("K", (0, 0, 0), -60, "focal lengths -60 and 60 px"),
        ("height", 0, 0, "64 x 0 pixels"),
    ],
)
def test_cameras_without_a_picture_are_refused_in_a_line(name, entry, value, said):
    bad = replace(camera(**SIZE, focal=60), names=("cam7",))
    array = getattr(bad, name).copy()
    array[entry] = value
    bad = replace(bad, **{name: array})
    memory = SpatialMemory(0.1)
    memory.fuse(points([(0, 0, 2)]), round=0)
    depth = np.ones((max(0, int(bad.height[0])), max(0, int(bad.width[0]))), np.float32)
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    calls: list[Callable[[], object]] = [
        lambda: check_usable(bad),
        bad.rays,
        bad.plucker,
        lambda: back_project(rgb, depth, bad),
    ]
    for backend in BACKENDS:
        calls.append(partial(memory.project, bad, options=SplatOptions(backend=backend)))
    for call in calls:
        with pytest.raises(ShapeError, match=said) as caught:
            call()
        assert str(caught.value).startswith("cam7: ")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest"])
@pytest.mark.parametrize("f", [1e-30, 1e6, 1e30])
@pytest.mark.parametrize("aside", [0.0, 1e10, -1e30])
def test_absurd_lenses_give_finite_pictures(f, aside, backend):
    good = camera(**SIZE, focal=60)
    K = np.array([[[f, 0, 32.5 + aside], [0, f, 24.5], [0, 0, 1]]])
    absurd = Cameras(K, good.cam_from_world, good.width, good.height, good.names)
    memory = SpatialMemory(0.1)
    memory.fuse(points([(0, 0, 2), (0.3, 0.2, 4), (-0.1, 5, 3)], spacing=0.1), round=0)
    seen = memory.project(absurd, options=SplatOptions(backend=backend))
    for image in (seen.rgb, seen.depth, seen.confidence):
        assert np.isfinite(image).all()
    if aside == 0:
        # The point on the axis stays there whatever the focal length is.
        assert seen.valid[0, 24, 32]
        assert 2 - 1e-5 <= seen.depth[0, 24, 32] <= 2.2
    else:
        assert not seen.valid.any()


pytestmark = pytest.mark.filterwarnings("error")

NOISE = np.random.default_rng(0).random((20, 24, 3))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 255.0, -1.01])
@pytest.mark.parametrize("call", [psnr, ssim, lambda a, b: image_figures(a, b, {"": None})])
def test_values_that_are_no_colours_are_refused_wherever_they_stand(call, bad):
    damaged = NOISE.copy()
    damaged[0, 0, 1] = bad
    for pair in ((damaged, NOISE), (NOISE, damaged)):
        with pytest.raises(ShapeError, match=r"expected floats in \[0, 1\]"):
            call(*pair)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (10, 11), (0, 5)])
def test_small_and_empty_pictures_have_what_they_can_have(size):
    picture = np.full((*size, 3), 0.5)
    wanted = math.inf if picture.size else None
    assert psnr(picture, picture) == wanted
    assert image_figures(picture, picture, {"": None})[""] == {"psnr": wanted, "ssim": None}
    with pytest.raises(ShapeError, match="11x11"):
        ssim(picture, picture)


@pytest.mark.parametrize(
    ("values", "mean", "n"),
    [
        ([None, math.nan], None, 0),
        ([-math.inf, 1.0], -math.inf, 2),
        ([math.inf, -math.inf], None, 2),
        ([1e-30], 1e-30, 1),
    ],
)
def test_means_that_have_no_interval(values, mean, n):
    found = mean_interval(values)
    assert (found.mean, found.low, found.high, found.n) == (mean, None, None, n)


TEXTURED = (24, 32)
TEXTURE = np.random.default_rng(0).integers(0, 256, (*TEXTURED, 3), dtype=np.uint8)


def wall(*, depth: float | None = 2.0, shift: float = 0.0) -> PosedPicture:
    pose = rigid_poses(np.eye(3), (-shift, 0, 0))
    camera = Cameras.pinhole(TEXTURED[1], TEXTURED[0], focal=30, cam_from_world=pose)
    lengths = None if depth is None else np.full(TEXTURED, depth, np.float32)
    return PosedPicture(f"at {shift:g}", camera, TEXTURE, lengths, None)


@settings(max_examples=30, deadline=None)
@given(st.integers(-36, 36), st.sampled_from([0.0, 0.1, 0.5]))
def test_exact_depth_agrees_in_any_unit(power, step):
    unit = 10.0**power
    first, second = wall(depth=2 * unit), wall(depth=2 * unit, shift=step * unit)
    found = depth_reprojection(first, second)
    assert found.ok
    assert found.mean_pixels == pytest.approx(0, abs=1e-10)
    assert found.mean_relative_depth == pytest.approx(0, abs=1e-12)
    # The wall moves by 30 step / 2 pixels.
    assert found.covisible == pytest.approx(24 * (32 - 15 * step), abs=24)


@pytest.mark.parametrize("depth", [np.nan, np.inf, -np.inf, 0.0, -1.0, None])
def test_depth_that_is_none_gives_a_status_and_no_figure(depth):
    for first, second in ((wall(depth=depth), wall()), (wall(), wall(depth=depth))):
        found = depth_reprojection(first, second)
        assert found.status.startswith("empty: ")
        assert found.mean_pixels is found.mean_relative_depth is None
        features = feature_consistency(first, second)
        assert features.status.startswith("empty: ")
        assert features.score is None and features.places == 0


def path(count: int = 9, *, unit: float = 1.0) -> np.ndarray:
    t = np.linspace(0, 2, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = unit * np.stack([np.cos(t), np.sin(t), 0.3 * t**2], 1)
    poses[:, :3, :3] = Rotation.from_rotvec(np.stack([0.2 * t, t, 0 * t], 1)).as_matrix()
    return poses


@settings(max_examples=30, deadline=None)
@given(st.integers(-29, 29))
def test_errors_scale_with_the_unit(power):
    unit = 10.0**power
    noise = 0.1 * np.random.default_rng(0).standard_normal((9, 3))
    found = []
    for scale in (1.0, unit):
        other = path(unit=scale)
        other[:, :3, 3] += scale * noise
        reference = path(unit=scale)
        ate = absolute_errors(reference, other).translation
        rpe = relative_errors(reference, other).translation
        auc = pose_auc(reference, other)
        assert ate is not None and rpe is not None
        found.append((ate.rmse / scale, rpe.rmse / scale, auc.median_direction_deg, auc.auc[30.0]))
    plain, scaled = np.array(found, np.float64)
    np.testing.assert_allclose(scaled, plain, rtol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-8, np.pi - 1e-12, np.pi])
def test_angles_are_exact_near_none_and_near_a_half_turn(angle):
    other = path()
    turn = Rotation.from_rotvec(angle * np.array([1, 2, 2]) / 3).as_matrix()
    other[:, :3, :3] = turn @ other[:, :3, :3]
    errors = absolute_errors(path(), other, align="none")
    assert errors.rotation_deg is not None
    for value in (errors.rotation_deg.min, errors.rotation_deg.max):
        # Entries of a rotation matrix end at 1e-16: so do the angles that it tells.
        assert value == pytest.approx(np.degrees(angle), rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("offset", [0.0, 1.0, 5e6])
def test_cameras_at_one_place_have_no_direction_up_to_rounding(offset):
    rng = np.random.default_rng(0)
    reference, estimate = path(), path()
    for poses in (reference, estimate):
        poses[:, :3, 3] = offset * (1 + 1e-15 * rng.standard_normal((9, 3)))
    auc = pose_auc(reference, estimate)
    assert auc.still == auc.pairs == 36
    assert auc.median_direction_deg is None
    assert auc.auc[3.0] == pytest.approx(1 - 0.5 / AUC_BINS)
    assert "coincident" in absolute_errors(reference, estimate).status


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_an_estimate_that_stands_still_is_off_by_a_right_angle(offset):
    estimate = path()
    noise = 1e-15 * np.random.default_rng(1).standard_normal((9, 3))
    estimate[:, :3, 3] = offset * (1 + noise)
    auc = pose_auc(path(), estimate)
    assert auc.still == 0
    assert auc.median_direction_deg == 90


@pytest.mark.parametrize("spoil", [np.zeros((3, 3)), np.diag([1.0, 1, -1]), 2 * np.eye(3)])
def test_what_is_no_rotation_is_refused_and_named(spoil):
    broken = path()
    broken[3, :3, :3] = spoil
    for call in (absolute_errors, relative_errors, pose_auc):
        with pytest.raises(ShapeError, match="estimate pose 3 is no rotation"):
            call(path(), broken)
        with pytest.raises(ShapeError, match="reference pose 3 is no rotation"):
            call(broken, path())


def test_an_error_that_is_no_number_is_a_failure():
    assert area_under_recall([np.nan, np.inf], 10.0) == 0
    assert area_under_recall([0.0, np.nan], 10.0) == pytest.approx(0.5, abs=1e-3)
