"""The pose probe on an exact room of three textured walls, its steps, and real photographs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from consistency_scene import real_pictures
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from walls import HEIGHT, WALLS, WIDTH, Float64, Take, blotches, camera_at, photograph

from gvtools.cameras import Cameras, rigid_poses
from gvtools.errors import CheckpointError, DegenerateError, ShapeError
from gvtools.evaluation import pose_probe
from gvtools.evaluation.pose_probe import (
    Located,
    PoseProbe,
    absolute_pose,
    angle_deg,
    center_distance,
    lift_keypoints,
    summarise,
)
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.features import SiftMatcher, mutual_nearest


@pytest.fixture(scope="session")
def textures() -> list[Float64]:
    rng = np.random.default_rng(7)
    return [blotches(rng) for _ in WALLS]


@pytest.fixture(scope="session")
def take(textures: list[Float64]) -> Take:
    def taken(camera: Cameras, claim: Cameras | None = None) -> PosedPicture:
        picture = photograph(camera, textures)
        # No depth: what a generated picture is.
        return dataclasses.replace(picture, camera=claim or camera, depth=None)

    return taken


@pytest.fixture(scope="session")
def context(textures: list[Float64]) -> list[PosedPicture]:
    cameras = [
        camera_at((0.25 * i - 0.5, 0.1 * (i % 2), 0.1 * i), turn=(3 * i - 4, 10 - 6 * i, 2 * i),
                  name=f"c{i}")
        for i in range(5)
    ]  # fmt: skip
    return [photograph(camera, textures) for camera in cameras]


@pytest.fixture(scope="session")
def probe(context: list[PosedPicture]) -> PoseProbe:
    return PoseProbe(context)


def test_a_picture_is_located_where_it_was_taken(probe, take):
    camera = camera_at((0.05, -0.05, 0.25), turn=(1, -4, 6))
    found = probe.locate(take(camera))
    assert found.status == "located", found
    assert found.rotation_error_deg < 0.04
    assert found.center_error < 3e-3
    assert found.center_error_share == pytest.approx(found.center_error / probe.extent)
    assert found.inliers > 100 and found.inlier_share > 0.8
    assert found.residual < 1


@pytest.mark.parametrize(
    ("step", "turn"),
    [((0.2, 0.0, 0.0), (0, 0, 0)), ((0.0, 0.0, 0.0), (0, 5, 0)), ((0.0, -0.1, 0.15), (3, 0, -8))],
    ids=["translation", "rotation", "both"],
)
def test_a_shift_between_claim_and_picture_is_reported(probe, take, step, turn):
    claim = camera_at((0.0, 0.0, 0.2))
    real = camera_at(np.array([0.0, 0.0, 0.2]) + step, turn=turn)
    found = probe.locate(take(real, claim))
    assert found.ok, found.status
    angle = Rotation.from_euler("xyz", turn, degrees=True).magnitude()
    assert found.rotation_error_deg == pytest.approx(np.degrees(angle), abs=0.04)
    assert found.center_error == pytest.approx(np.linalg.norm(step), abs=3e-3)


def test_no_half_pixel_between_keypoints_and_cameras(probe, take):
    # In a picture upside down, an offset of the keypoints from the camera's convention counts
    # twice; in one of half the size, it is another share of the picture. Half a pixel of 200
    # across is 0.15 degrees.
    for scale, turn in ((1.0, (0, 0, 180)), (1.0, (0, 0, 90)), (0.5, (0, 0, 0))):
        camera = camera_at((0.0, 0.0, 0.2), turn=turn, scale=scale)
        found = probe.locate(take(camera))
        assert found.ok, found.status
        assert found.rotation_error_deg < 0.05, (scale, turn)


def test_the_claim_is_not_used_to_locate(probe, take):
    camera = camera_at((0.1, 0.0, 0.2), turn=(0, 3, 0))
    honest = probe.locate(take(camera))
    wrong = probe.locate(take(camera, camera_at((5.0, 5.0, -9.0), turn=(70, 20, 160))))
    np.testing.assert_array_equal(honest.cam_from_world, wrong.cam_from_world)
    assert wrong.center_error > 5


def test_views_are_chosen_by_the_picture_alone(probe, context, take, monkeypatch):
    monkeypatch.setattr(pose_probe, "VIEWS", 2)
    near = context[3].camera.centers[0] + [0.02, 0.0, 0.0]
    camera = camera_at(near, turn=(5, -8, 6))
    found = probe.locate(take(camera, camera_at((9.0, 9.0, 9.0))))
    assert len(found.views) == 2 and "c3" in found.views


def test_unrelated_pictures_fail_and_say_why(probe, take):
    rng = np.random.default_rng(1)
    elsewhere = [blotches(rng) for _ in WALLS]
    camera = camera_at((0.0, 0.0, 0.2))
    grey = np.full((HEIGHT, WIDTH, 3), 127, np.uint8)
    noise = rng.integers(0, 256, grey.shape).astype(np.uint8)
    mirrored = take(camera).rgb[:, ::-1].copy()
    for rgb in (grey, noise, mirrored, photograph(camera, elsewhere).rgb):
        found = probe.locate(PosedPicture("generated", camera, rgb))
        assert found.status.startswith("failed: "), found
        assert found.cam_from_world is None and found.center_error is None
        assert found.rotation_error_deg is None and found.residual is None


def test_a_picture_that_two_poses_explain_is_ambiguous_unless_a_mask_leaves_one_of_them(
    probe, take
):
    # Left half from one place, right half from another: each half has its own pose.
    camera, other = camera_at((-0.3, 0.0, 0.2)), camera_at((0.4, 0.0, 0.2), turn=(0, 0, 30))
    rgb = take(camera).rgb.copy()
    rgb[:, WIDTH // 2 :] = take(other).rgb[:, WIDTH // 2 :]
    found = probe.locate(PosedPicture("torn", camera, rgb))
    assert found.status.startswith("failed: ambiguous"), found
    assert found.rival >= 0.5 * found.inliers
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 2 - 8] = True
    found = probe.locate(PosedPicture("left half", camera, rgb, mask=mask))
    assert found.ok and found.center_error < 0.02
    masked = probe.locate(PosedPicture("nothing", camera, rgb, mask=np.zeros_like(mask)))
    assert masked.status.startswith("failed") and masked.keypoints == 0


def test_a_context_without_depth_is_refused(context):
    with pytest.raises(DegenerateError, match="none of 1 context views"):
        PoseProbe([dataclasses.replace(context[0], depth=None)])


def test_leave_one_out_measures_the_probe_itself(probe):
    found = probe.leave_one_out(3)
    assert [one.name for one in found] == ["c0", "c2", "c4"]
    assert all(one.name not in one.views for one in found)
    summary = summarise(found)
    assert summary.success_share == 1
    assert summary.center_error.max < 0.01


def test_far_from_the_origin(context, take):
    offset = np.array([5e5, -4e6, 300.0])

    def moved(camera: Cameras) -> Cameras:
        pose = camera.cam_from_world.copy()
        pose[0, :3, 3] -= pose[0, :3, :3] @ offset
        return dataclasses.replace(camera, cam_from_world=pose)

    far = PoseProbe([dataclasses.replace(c, camera=moved(c.camera)) for c in context[:3]])
    camera = camera_at((0.0, 0.0, 0.2))
    found = far.locate(take(camera, moved(camera)))
    assert found.ok and found.center_error < 5e-3


def test_lightglue_reads_weights_of_a_folder_and_refuses_others(tmp_path, context):
    import torch

    from gvtools import features

    pytest.importorskip("kornia.feature.aliked", reason="kornia without ALIKED")

    torch.manual_seed(0)
    files = features.FILES["aliked"]
    random = features.networks("aliked", 64)
    for network, name in zip(random, files, strict=True):
        torch.save(network.state_dict(), tmp_path / name)
    matcher = features.LightGlueMatcher(max_features=64, weights=tmp_path)
    for network, stored in zip((matcher._extractor, matcher._matcher), random, strict=True):
        for name, tensor in stored.state_dict().items():
            assert torch.equal(network.state_dict()[name], tensor), name
    found = matcher.extract(context[0].rgb)
    assert found.descriptors.shape == (len(found), 128)
    pairs = matcher.match(found, found)
    assert pairs.ndim == 2 and pairs.shape[1] == 2

    weights = random[1].state_dict()
    torch.save(weights | {"input_proj.weight": torch.zeros(2, 2)}, tmp_path / files[1])
    with pytest.raises(CheckpointError, match=r"input_proj\.weight.*another network"):
        features.LightGlueMatcher(weights=tmp_path)
    del weights["input_proj.weight"]
    torch.save(weights, tmp_path / files[1])
    with pytest.raises(CheckpointError, match=r"no input_proj\.weight"):
        features.LightGlueMatcher(weights=tmp_path)
    (tmp_path / files[1]).unlink()
    with pytest.raises(CheckpointError, match="download it"):
        features.LightGlueMatcher(weights=tmp_path)


@pytest.mark.parametrize("place", [(100.5, 80.5), (100.3, 80.7), (60.0, 40.0)])
def test_sift_counts_from_the_corner_of_the_first_pixel(place):
    y, x = np.mgrid[0:160, 0:200] + 0.5
    blob = 40 + 200 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 4**2))
    features = SiftMatcher().extract(np.repeat(blob[..., None], 3, axis=2).round().astype(np.uint8))
    assert np.abs(features.xy - place).max(axis=1).min() < 0.05
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, rtol=1e-5)


def test_a_picture_without_anything_has_no_features():
    assert len(SiftMatcher().extract(np.zeros((40, 60, 3), np.uint8))) == 0
    with pytest.raises(ShapeError, match="expected uint8"):
        SiftMatcher().extract(np.zeros((40, 60), np.uint8))


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 40), st.integers(0, 40), st.integers(0, 10_000))
def test_mutual_nearest_is_what_a_plain_loop_finds(n, m, seed):
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


def test_keypoints_at_depth_edges_and_holes_are_left_out():
    camera = camera_at((0.0, 0.0, 0.0))
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth[:, 100:] = 1.0
    depth[50, 20] = 0
    depth[60, 20] = np.nan
    xy = np.array([[99.9, 30], [90, 30], [20.4, 50.6], [21.2, 60.1], [0.1, 0.1], [WIDTH, HEIGHT]])
    xy[-1] -= 0.1
    points, ok = lift_keypoints(xy, depth, camera, edge=0.05)
    assert ok.tolist() == [False, True, False, False, True, True]
    np.testing.assert_allclose(np.linalg.inv(camera.K[0]) @ [90, 30, 1] * 2, points[1])


def test_absolute_pose_of_exact_matches_with_skew_and_outliers():
    rng = np.random.default_rng(5)
    points = rng.uniform([-1, -1, 2], [1, 1, 5], (200, 3))
    camera = camera_at((0.1, 0.2, -0.3), turn=(5, -7, 20))
    K = camera.K.copy()
    K[0, 0, 1] = 15.0
    xy = dataclasses.replace(camera, K=K).project(points)[0][0]
    xy[:60] = rng.uniform([0, 0], [WIDTH, HEIGHT], (60, 2))
    pose = absolute_pose(xy, points, K[0], max_error=2.0)
    truth = camera.cam_from_world[0]
    assert angle_deg(pose.cam_from_world[:3, :3], truth[:3, :3]) < 1e-4
    assert center_distance(pose.cam_from_world, truth) < 1e-5
    assert pose.inliers[60:].all() and pose.inliers[:60].sum() <= 2
    assert absolute_pose(xy[:3], points[:3], K[0], max_error=2.0) is None


@given(st.floats(1e-9, 179.9), st.integers(0, 1000))
def test_angle_between_orientations(degrees, seed):
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    first = Rotation.random(random_state=seed).as_matrix()
    second = Rotation.from_rotvec(axis * np.radians(degrees)).as_matrix() @ first
    assert angle_deg(first, second) == pytest.approx(degrees, rel=1e-5, abs=1e-12)


def located(name: str, rotation: float, center: float) -> Located:
    return Located(
        name=name, status="located", keypoints=500, matches=90, inliers=60, views=("c0",),
        rotation_error_deg=rotation, center_error=center, center_error_share=center,
    )  # fmt: skip


FAILED = Located(name="b", status="failed: 3 inliers", keypoints=500, matches=90, views=("c0",))


def test_a_summary_counts_failures_as_failures():
    summary = summarise([located("a", 1.0, 0.3), FAILED, located("c", 3.0, 0.1)])
    assert (summary.pictures, summary.located) == (3, 2)
    assert summary.success_share == pytest.approx(2 / 3)
    assert summary.failures == (("b", FAILED.status),)
    assert (summary.rotation_error_deg.n, summary.rotation_error_deg.median) == (2, 2)
    assert summary.center_error.rmse == pytest.approx(np.sqrt(0.05))
    # Share of all pictures below x degrees: 0 to 1, a third to 3, two thirds to 5.
    assert summary.rotation_auc[5.0] == pytest.approx((2 / 3 + 4 / 3) / 5, abs=2e-3)
    none = summarise([FAILED])
    assert (none.success_share, none.rotation_auc[5.0]) == (0, 0)
    assert none.rotation_error_deg is None and none.center_error is None and none.inliers is None
    nothing = summarise([])
    assert nothing.success_share is None and nothing.rotation_auc[5.0] is None


@pytest.mark.data
@pytest.mark.slow
def test_held_out_photographs_and_shifted_projections(shared):
    from gvtools.memory.spatial_memory import SpatialMemory

    context = real_pictures(shared, slice(0, None, 2))
    targets = real_pictures(shared, slice(1, None, 2))
    probe = PoseProbe(context)
    summary = summarise([probe.locate(one) for one in targets])
    assert summary.success_share >= 0.95, summary.failures
    assert summary.rotation_error_deg.median <= 1
    assert summary.center_error.median <= 0.03

    memory = SpatialMemory(0.01)
    for one in context:
        memory.observe(one.rgb, one.depth, one.camera, round=0)
    for step, turn in (((0.0, 0, 0.2), (0, 0, 0)), ((0.0, 0, 0), (0, 5, 0))):
        move = rigid_poses(Rotation.from_euler("xyz", turn, degrees=True).as_matrix(), step)
        found = []
        for one in targets[::5]:
            pose = move @ one.camera.cam_from_world
            seen = memory.project(dataclasses.replace(one.camera, cam_from_world=pose))
            rgb = np.rint(255 * seen.rgb[0]).astype(np.uint8)
            found.append(probe.locate(PosedPicture(one.name, one.camera, rgb, mask=seen.valid[0])))
        shifted = summarise(found)
        assert shifted.success_share == 1, shifted.failures
        assert shifted.rotation_error_deg.median == pytest.approx(max(turn), abs=0.3)
        assert shifted.center_error.median == pytest.approx(max(step), abs=0.01)
