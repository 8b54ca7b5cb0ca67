"""Depth ranges, source views, pose adjustment, consistency: where the answer is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from stereo_scenes import plane_scene

from gvtools.cameras import Cameras, invert_rigid
from gvtools.depth.stereo.filtering import agreement
from gvtools.depth.stereo.geometry import (
    choose_sources,
    estimate_range,
    range_of_depths,
    seen_points,
)
from gvtools.depth.stereo.matching import build_pyramid, level_of, residual_flow
from gvtools.errors import DegenerateError
from gvtools.poses.dense_adjustment import adjust_cameras, pose_equations
from gvtools.scenes.scene import Scene, SparsePoints
from gvtools.trajectories import look_at


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


def test_range_ignores_a_few_outliers():
    depths = np.concatenate([np.full(990, 2.0), np.full(5, 0.01), np.full(5, 1e4)])
    found = range_of_depths(depths, origin="points")
    assert 1 < found.near < 2 < found.far < 4


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


def test_agreement_invents_nothing():
    made = plane_scene()
    cameras = made.scene.cameras
    inverse = [torch.from_numpy(1 / depth).float() for depth in made.depths]
    inverse[2][40:60] = 0
    found = agreement(inverse[2], cameras[2], [(inverse[1], cameras[1])], tolerance=0.02)
    assert (found.inverse_depth[40:60] == 0).all()
    assert (found.views[40:60] == 0).all()


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
