"""Warps, hypotheses and matching: known geometry, and the compiled back end against torch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from stereo_scenes import plane_scene

from gvtools.cameras import Cameras, invert_rigid
from gvtools.depth.options import StereoOptions
from gvtools.depth.stereo.filtering import agreement
from gvtools.depth.stereo.geometry import (
    DepthRange,
    best_plane,
    choose_sources,
    disparity_rate,
    estimate_range,
    parabola,
    plane_hypotheses,
    relative_warps,
    seen_points,
)
from gvtools.depth.stereo.matching import (
    TorchMatcher,
    bilinear,
    build_pyramid,
    level_of,
    residual_flow,
    window_taps,
    window_weights,
)
from gvtools.depth.stereo.matching_cpu import CpuMatcher
from gvtools.depth.stereo.plane_sweep import fit_planes, make_matcher, refine_planes, upsample
from gvtools.errors import DegenerateError, OptionError
from gvtools.poses.dense_adjustment import adjust_cameras, pose_equations
from gvtools.scenes.scene import Scene, SparsePoints
from gvtools.trajectories import look_at

OPTIONS = StereoOptions(sources=2, best=1)


@pytest.fixture(scope="module")
def slanted():
    """A slanted plane: the middle view's level with two sources, and the exact planes."""
    made = plane_scene(slope=(0.25, -0.15))
    scene = made.scene
    pyramids = [
        build_pyramid(view.load().rgb, view.camera, max_side=640, levels=1) for view in scene
    ]
    level = level_of(
        pyramids[2], [pyramids[0], pyramids[4]], 0, window=7, device=torch.device("cpu")
    )
    inverse = 1 / made.depths[2]
    planes = np.stack([inverse, np.gradient(inverse, axis=1), np.gradient(inverse, axis=0)])
    return made, level, torch.from_numpy(planes.astype(np.float32))


def test_warps_agree_with_projection(slanted):
    made, _, _ = slanted
    cameras = made.scene.cameras
    warps = relative_warps(cameras[2], cameras[[0, 4]])
    xy = np.array([[10.5, 20.5], [80.5, 60.5], [150.5, 100.5]])
    depth = made.depths[2][(xy[:, 1]).astype(int), xy[:, 0].astype(int)]
    rays = cameras[2].rays()[xy[:, 1].astype(int), xy[:, 0].astype(int)]
    local = np.concatenate([rays * depth[:, None], np.ones((3, 1))], axis=1)
    points = (local @ cameras.world_from_cam[2].T)[:, :3]
    expected, _ = cameras[[0, 4]].project(points)
    found, ratio = warps.project(xy, 1 / depth)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert (ratio > 0).all()


def test_disparity_rate_of_a_sidestep_is_focal_times_baseline():
    scene = plane_scene(count=2, turns=False).scene
    cameras = scene.cameras
    pose = cameras.cam_from_world.copy()
    pose[1] = pose[0]
    pose[1, 0, 3] -= 0.1
    rate = disparity_rate(cameras[0], replace(cameras, cam_from_world=pose)[1], 1.0, far=10.0)
    assert rate[0] == pytest.approx(0.1 * cameras.K[0, 0, 0])


def test_planes_are_one_pixel_apart_in_the_widest_source():
    cameras = plane_scene(turns=False).scene.cameras
    depths = DepthRange(1.0, 5.0, 1.5, 2.5, "points")
    planes = plane_hypotheses(cameras[2], cameras[[0, 1]], depths, planes=None)
    rate = disparity_rate(cameras[2], cameras[[0, 1]], 1.0, far=5.0).max()
    assert 0.9 < planes.step * rate <= 1.0
    assert float(planes.inverse_depths[0]) == pytest.approx(0.2)
    assert float(planes.inverse_depths[-1]) == pytest.approx(1.0)
    assert len(plane_hypotheses(cameras[2], cameras[[0]], depths, planes=33).inverse_depths) == 33


def test_parabola_finds_the_vertex():
    x = torch.tensor([-1.0, 0.0, 1.0]) - 0.3
    left, middle, right = 2 * x**2 + 0.1
    assert float(parabola(left, middle, right)) == pytest.approx(0.3, abs=1e-5)
    flat = torch.tensor(0.5)
    assert float(parabola(flat, flat, flat)) == 0


@pytest.mark.parametrize("matcher", [CpuMatcher(OPTIONS), TorchMatcher(OPTIONS)])
def test_score_is_near_zero_on_the_true_plane_and_high_off_it(slanted, matcher):
    _, level, planes = slanted
    inner = (slice(8, -8), slice(8, -8))
    right = matcher.score(level, planes)[inner]
    off = planes.clone()
    off[0] *= 1.1
    wrong = matcher.score(level, off)[inner]
    assert float(right.median()) < 0.02
    assert float(wrong.median()) > 0.1


def test_compiled_score_equals_torch(slanted):
    _, level, planes = slanted
    rng = torch.Generator().manual_seed(0)
    shaken = planes * (1 + 0.05 * torch.randn(planes.shape, generator=rng))
    one, two = CpuMatcher(OPTIONS).score(level, shaken), TorchMatcher(OPTIONS).score(level, shaken)
    assert float(((one - two).abs() > 1e-3).float().mean()) < 1e-3
    assert float((one - two).abs().mean()) < 2e-5


@pytest.mark.parametrize("best", [1, 2])
def test_compiled_sweep_equals_torch(slanted, best):
    _, level, _ = slanted
    options = StereoOptions(sources=2, best=best)
    inverse = torch.linspace(0.2, 1.0, 9)
    one = CpuMatcher(options).sweep(level, inverse)
    two = TorchMatcher(options).sweep(level, inverse)
    assert one.shape == (*level.reference.shape, 9)
    assert float((one - two).abs().mean()) < 1e-4
    assert float(((one - two).abs() > 5e-3).float().mean()) < 5e-3


def test_compiled_aggregation_equals_torch():
    rng = torch.Generator().manual_seed(1)
    volume = torch.rand((20, 31, 12), generator=rng)
    guide = torch.rand((20, 31), generator=rng)
    one = CpuMatcher(OPTIONS).aggregate(volume, guide)
    two = TorchMatcher(OPTIONS).aggregate(volume, guide)
    torch.testing.assert_close(one, two, atol=1e-5, rtol=1e-5)


def test_aggregation_fills_an_ambiguous_strip_from_its_sides():
    volume = torch.ones((9, 30, 8))
    volume[..., 3] = 0.2
    volume[:, 12:18] = 0.5  # nothing to tell the planes apart
    total = CpuMatcher(OPTIONS).aggregate(volume, torch.full((9, 30), 0.5))
    assert (total.argmin(-1) == 3).all()


def test_sweep_and_parabola_find_the_plane(slanted):
    made, level, _ = slanted
    cameras = made.scene.cameras
    depths = DepthRange(1.0, 5.0, 1.5, 2.5, "points")
    planes = plane_hypotheses(cameras[2], cameras[[0, 4]], depths, planes=None)
    matcher = CpuMatcher(OPTIONS)
    volume = matcher.aggregate(matcher.sweep(level, planes.inverse_depths), level.reference)
    inverse, _ = best_plane(volume, planes)
    error = (inverse.numpy() * made.depths[2] - 1)[10:-10, 10:-10]
    assert np.median(np.abs(error)) < 0.01


def test_refinement_reaches_sub_percent_depth_from_a_rough_start(slanted):
    made, level, planes = slanted
    rate = disparity_rate(made.scene.cameras[2], made.scene.cameras[[0, 4]], 1.0, far=5.0).max()
    start = planes.clone()
    start[0] += 0.4 / rate * torch.sign(torch.sin(torch.arange(start.shape[2]) * 0.3))
    start[1:] = 0
    found, cost = refine_planes(
        start, level, CpuMatcher(OPTIONS), step=1 / rate, bounds=(0.2, 1.0), iterations=2
    )
    error = (found[0].numpy() * made.depths[2] - 1)[10:-10, 10:-10]
    assert np.median(np.abs(error)) < 0.003
    assert float(cost[10:-10, 10:-10].median()) < 0.03


def test_fitted_and_upsampled_are_exact_on_a_plane():
    y, x = torch.meshgrid(torch.arange(12.0) + 0.5, torch.arange(16.0) + 0.5, indexing="ij")
    w = 0.4 + 0.01 * x - 0.02 * y
    planes = fit_planes(w, torch.ones_like(w))
    inner = (slice(4, -4), slice(4, -4))
    assert float((planes[0] - w)[inner].abs().max()) < 1e-4
    assert float((planes[1] - 0.01)[inner].abs().max()) < 2e-4
    exact = torch.stack([w, torch.full_like(w, 0.01), torch.full_like(w, -0.02)])
    fine = upsample(exact, 24, 32)
    y, x = torch.meshgrid(torch.arange(24.0) + 0.5, torch.arange(32.0) + 0.5, indexing="ij")
    torch.testing.assert_close(fine[0], 0.4 + 0.005 * x - 0.01 * y)
    torch.testing.assert_close(fine[1], torch.full((24, 32), 0.005))


def test_window_weights_sum_to_one_and_stop_at_edges():
    image = torch.zeros((10, 10))
    image[:, 5:] = 1
    taps = window_taps(5)
    weights = window_weights(image, taps)
    torch.testing.assert_close(weights.sum(-1), torch.ones((10, 10)))
    across = (taps[:, 0] > 0) & (taps[:, 1] == 0)
    assert float(weights[5, 4, across].sum()) < 1e-3


def test_cuda_without_a_device_is_refused():
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(OptionError, match="no CUDA device"):
        make_matcher(StereoOptions(backend="torch", device="cuda"))


RNG = np.random.default_rng(5)


def test_values_between_pixels_are_scipys_with_centres_at_a_half() -> None:
    picture = RNG.random((40, 60)).astype(np.float32)
    padded = np.full((45, 70), np.nan, np.float32)
    padded[:40, :60] = picture
    x, y = RNG.uniform(-5, 65, (2, 30, 50)).astype(np.float32)
    found = bilinear(torch.from_numpy(padded), [60, 40], torch.from_numpy(x), torch.from_numpy(y))
    expected = map_coordinates(picture, [y - 0.5, x - 0.5], order=1, mode="nearest")
    np.testing.assert_allclose(found, expected, atol=2e-5)


def with_points(scene: Scene, depth: float = 2.0, count: int = 60) -> Scene:
    """The scene with points on the plane z = depth, seen by the views that contain them."""
    rng = np.random.default_rng(3)
    positions = np.concatenate([rng.uniform(-0.6, 0.6, (count, 2)), np.full((count, 1), depth)], 1)
    xy, _ = scene.cameras.project(positions)
    size = np.array([scene.cameras.width[0], scene.cameras.height[0]])
    seen = (xy > 0).all(-1) & (xy < size).all(-1)
    view, point = np.nonzero(seen)
    points = SparsePoints(
        positions,
        np.zeros((count, 3), np.uint8),
        np.zeros(count, np.float32),
        point.astype(np.int32),
        view.astype(np.int32),
        xy[view, point],
    )
    return replace(scene, points=points)


def ring(count: int = 8, radius: float = 3.0) -> Scene:
    """Cameras on a circle that look at its centre; nothing to load."""
    base = plane_scene().scene
    views = []
    for i in range(count):
        angle = 0.25 * i
        eye = np.array([radius * np.cos(angle), radius * np.sin(angle), 0.1 * (i % 2)])
        pose = look_at(eye[None], np.zeros(3), up=[0, 0, 1])
        camera = replace(base.views[0].camera, cam_from_world=invert_rigid(pose), names=(f"r{i}",))
        views.append(replace(base.views[0], name=f"r{i}", camera=camera))
    return Scene(Path("ring"), "colmap", tuple(views))


def test_range_from_points_encloses_them():
    scene = with_points(plane_scene().scene)
    found = estimate_range(scene, "v2")
    assert found.origin == "points"
    assert found.near < 2.0 - 0.1 < found.far
    assert found.lower == pytest.approx(2.0, abs=0.1)
    tracks = seen_points(scene, "v2")
    assert tracks is not None
    assert tracks.seen_by([2]).all()


def test_range_from_axes_that_meet():
    found = estimate_range(ring(), "r3")
    assert found.origin == "axes"
    assert np.sqrt(found.lower * found.upper) == pytest.approx(3.0, rel=0.05)


def test_range_from_baselines_when_axes_are_parallel():
    found = estimate_range(plane_scene(turns=False).scene, "v2")
    assert found.origin == "baseline"
    assert found.near < 2.0 < found.far


def test_views_at_one_place_are_refused():
    scene = plane_scene(count=2).scene
    same = tuple(replace(view, camera=scene.views[0].camera) for view in scene)
    with pytest.raises(DegenerateError, match="v0 has no other view at another place"):
        estimate_range(replace(scene, views=same), "v0")


def test_sources_by_tracks_and_by_cameras():
    scene = ring()
    depths = estimate_range(scene, "r0")
    chosen = choose_sources(scene, "r0", scene.names, count=3, depths=depths)
    # 14 degrees between neighbours: the nearest neighbour is best, the far side shares nothing.
    assert chosen[0] == "r1"
    assert "r0" not in chosen
    planes = with_points(plane_scene().scene)
    by_tracks = choose_sources(
        planes, "v2", planes.names, count=4, depths=estimate_range(planes, "v2")
    )
    assert set(by_tracks) == {"v0", "v1", "v3", "v4"}
    assert by_tracks[0] in ("v0", "v4")  # 7 degrees rather than 3.5


def test_only_candidates_are_chosen():
    scene = plane_scene().scene
    depths = estimate_range(scene, "v2")
    chosen = choose_sources(scene, "v2", ("v0", "v1", "v2"), count=4, depths=depths)
    assert set(chosen) == {"v0", "v1"}
    assert choose_sources(scene, "v2", ("v2",), count=4, depths=depths) == ()


def test_agreement_counts_and_averages_views():
    made = plane_scene(slope=(0.1, 0.0))
    cameras = made.scene.cameras
    inverse = [torch.from_numpy(1 / depth).float() for depth in made.depths]
    found = agreement(
        inverse[2],
        cameras[2],
        [(inverse[1], cameras[1]), (inverse[3], cameras[3]), (inverse[4] * 1.2, cameras[4])],
        tolerance=0.02,
    )
    middle = (slice(30, 90), slice(50, 110))
    assert (found.views[middle] == 2).all()
    torch.testing.assert_close(found.inverse_depth[middle], inverse[2][middle], rtol=5e-3, atol=0)
    assert float(found.spread.max()) < 0.02


def test_disturbed_poses_are_found_again():
    made = plane_scene(slope=(0.3, 0.2))
    true = made.scene.cameras
    rng = np.random.default_rng(0)
    pose = true.cam_from_world.copy()
    for i in (0, 1, 3, 4):
        pose[i, :3] = Rotation.from_rotvec(rng.normal(0, 0.004, 3)).as_matrix() @ pose[i, :3]
    disturbed = replace(true, cam_from_world=pose)
    pyramids = [
        build_pyramid(view.load().rgb, disturbed[i], max_side=640, levels=1)
        for i, view in enumerate(made.scene)
    ]
    equations = []
    for i in range(5):
        others = [k for k in range(5) if k != i]
        level = level_of(
            pyramids[i], [pyramids[k] for k in others], 0, window=7, device=torch.device("cpu")
        )
        inverse = torch.from_numpy(1 / made.depths[i]).float()
        flow = residual_flow(level, inverse, noise=0.006)
        found = pose_equations(
            disturbed[others], disturbed[i], inverse.numpy(),
            motion=torch.stack([flow.dx, flow.dy], -1).numpy(), weight=flow.weight.numpy(),
        )  # fmt: skip
        assert found is not None
        equations.append((i, others, found))
    cameras = adjust_cameras(disturbed, equations, rotation=0.01, translation=0.01)
    before, after = _epipolar(disturbed, true), _epipolar(cameras, true)
    assert before > 0.3
    assert after < 0.35 * before


def _epipolar(cameras: Cameras, true: Cameras) -> float:
    """Mean error, pixels, of points of the other views relative to the middle one."""
    grid = np.stack(np.meshgrid([-0.5, 0, 0.5], [-0.4, 0, 0.4], [1.8, 2.2]), -1).reshape(-1, 3)
    relative = cameras.cam_from_world @ cameras.world_from_cam[2]
    carried = replace(cameras, cam_from_world=relative @ true.cam_from_world[2])
    return float(
        np.nanmean(np.linalg.norm(carried.project(grid)[0] - true.project(grid)[0], axis=-1))
    )
