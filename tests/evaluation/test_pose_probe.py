"""The pose probe on an exact room of three textured walls."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walls import (
    HEIGHT,
    WALLS,
    WIDTH,
    Take,
    blotches,
    camera_at,
    photograph,
)

from gvtools.cameras import Cameras
from gvtools.errors import CheckpointError, DegenerateError, OptionError
from gvtools.evaluation.pose_probe import (
    PoseProbe,
    PoseProbeOptions,
    summarise,
)
from gvtools.evaluation.posed_picture import PosedPicture

pytest_plugins = ("wall_fixtures",)


def test_a_picture_is_located_where_it_was_taken(probe: PoseProbe, take: Take) -> None:
    camera = camera_at((0.05, -0.05, 0.25), turn=(1, -4, 6))
    found = probe.locate(take(camera))
    assert found.status == "located", found
    assert found.cam_from_world is not None
    assert found.rotation_error_deg is not None and found.rotation_error_deg < 0.04
    assert found.center_error is not None and found.center_error < 3e-3
    assert found.center_error_share == pytest.approx(found.center_error / probe.extent)
    assert found.inliers > 100 and found.inlier_share is not None and found.inlier_share > 0.8
    assert found.residual is not None and found.residual < 1


@pytest.mark.parametrize(
    ("step", "turn"),
    [((0.2, 0.0, 0.0), (0, 0, 0)), ((0.0, 0.0, 0.0), (0, 5, 0)), ((0.0, -0.1, 0.15), (3, 0, -8))],
    ids=["translation", "rotation", "both"],
)
def test_a_shift_between_claim_and_picture_is_reported(
    probe: PoseProbe,
    take: Take,
    step: tuple[float, ...],
    turn: tuple[float, ...],
) -> None:
    claim = camera_at((0.0, 0.0, 0.2))
    real = camera_at(np.array([0.0, 0.0, 0.2]) + step, turn=turn)
    found = probe.locate(take(real, claim))
    assert found.ok, found.status
    angle = Rotation.from_euler("xyz", turn, degrees=True).magnitude()
    assert found.rotation_error_deg == pytest.approx(np.degrees(angle), abs=0.04)
    assert found.center_error == pytest.approx(np.linalg.norm(step), abs=3e-3)


def test_no_half_pixel_between_keypoints_and_cameras(probe: PoseProbe, take: Take) -> None:
    # In a picture upside down, an offset of the keypoints from the camera's convention counts
    # twice; in one of half the size, it is another share of the picture. Half a pixel of 320
    # across is 0.1 degrees.
    for scale, turn in ((1.0, (0, 0, 180)), (1.0, (0, 0, 90)), (0.5, (0, 0, 0))):
        camera = camera_at((0.0, 0.0, 0.2), turn=turn, scale=scale)
        found = probe.locate(take(camera))
        assert found.ok and found.rotation_error_deg is not None, found.status
        assert found.rotation_error_deg < 0.05, (scale, turn)


def test_the_claim_is_not_used_to_locate(probe: PoseProbe, take: Take) -> None:
    camera = camera_at((0.1, 0.0, 0.2), turn=(0, 3, 0))
    honest = probe.locate(take(camera))
    wrong = probe.locate(take(camera, camera_at((5.0, 5.0, -9.0), turn=(70, 20, 160))))
    assert honest.cam_from_world is not None and wrong.cam_from_world is not None
    np.testing.assert_array_equal(honest.cam_from_world, wrong.cam_from_world)
    assert wrong.center_error is not None and wrong.center_error > 5


def test_views_are_chosen_by_the_picture_alone(context: list[PosedPicture], take: Take) -> None:
    few = PoseProbe(context, options=PoseProbeOptions(views=2))
    near = context[3].camera.centers[0] + [0.02, 0.0, 0.0]
    camera = camera_at(near, turn=(5, -8, 6))
    found = few.locate(take(camera, camera_at((9.0, 9.0, 9.0))))
    assert len(found.views) == 2 and "c3" in found.views


def test_unrelated_pictures_fail_and_say_why(probe: PoseProbe, take: Take) -> None:
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


def test_a_picture_that_two_poses_explain_is_ambiguous(probe: PoseProbe, take: Take) -> None:
    # Left half from one place, right half from another: each half has its own pose.
    camera, other = camera_at((-0.3, 0.0, 0.2)), camera_at((0.4, 0.0, 0.2), turn=(0, 0, 30))
    rgb = take(camera).rgb.copy()
    rgb[:, WIDTH // 2 :] = take(other).rgb[:, WIDTH // 2 :]
    found = probe.locate(PosedPicture("torn", camera, rgb))
    assert found.status.startswith("failed: ambiguous"), found
    assert found.rival >= 0.5 * found.inliers


def test_a_mask_limits_where_the_picture_is_looked_at(probe: PoseProbe, take: Take) -> None:
    camera, other = camera_at((-0.3, 0.0, 0.2)), camera_at((0.4, 0.0, 0.2), turn=(0, 0, 30))
    rgb = take(camera).rgb.copy()
    rgb[:, WIDTH // 2 :] = take(other).rgb[:, WIDTH // 2 :]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 2 - 8] = True
    found = probe.locate(PosedPicture("left half", camera, rgb, mask=mask))
    assert found.ok and found.center_error is not None and found.center_error < 0.02
    masked = probe.locate(PosedPicture("nothing", camera, rgb, mask=np.zeros_like(mask)))
    assert masked.status.startswith("failed") and masked.keypoints == 0


def test_a_context_without_depth_or_with_equal_names_is_refused(
    context: list[PosedPicture],
) -> None:
    with pytest.raises(DegenerateError, match="none of 1 context views"):
        PoseProbe([dataclasses.replace(context[0], depth=None)])
    with pytest.raises(OptionError, match="one name"):
        PoseProbe([context[0], context[0]])


def test_leave_one_out_measures_the_probe_itself(probe: PoseProbe) -> None:
    found = probe.leave_one_out(3)
    assert [one.name for one in found] == ["c0", "c2", "c4"]
    assert all(one.name not in one.views for one in found)
    summary = summarise(found)
    assert summary.success_share == 1
    assert summary.center_error is not None and summary.center_error.max < 0.01


def test_far_from_the_origin(context: list[PosedPicture], take: Take) -> None:
    offset = np.array([5e5, -4e6, 300.0])

    def moved(camera: Cameras) -> Cameras:
        pose = camera.cam_from_world.copy()
        pose[0, :3, 3] -= pose[0, :3, :3] @ offset
        return dataclasses.replace(camera, cam_from_world=pose)

    far = PoseProbe([dataclasses.replace(c, camera=moved(c.camera)) for c in context[:3]])
    camera = camera_at((0.0, 0.0, 0.2))
    found = far.locate(take(camera, moved(camera)))
    assert found.ok and found.center_error is not None and found.center_error < 5e-3


def test_lightglue_locates_without_an_offset(context: list[PosedPicture], take: Take) -> None:
    from gvtools.features import LightGlueMatcher

    try:
        matcher = LightGlueMatcher()
    except CheckpointError as absent:
        pytest.skip(str(absent))
    probe = PoseProbe(context[:2], matcher=matcher)
    camera = camera_at((-0.2, 0.0, 0.2), turn=(0, 0, 20))
    found = probe.locate(take(camera))
    assert found.ok and found.rotation_error_deg is not None, found.status
    assert found.rotation_error_deg < 0.2


def test_lightglue_reads_weights_of_a_folder_and_refuses_others(
    tmp_path: Path, context: list[PosedPicture]
) -> None:
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
