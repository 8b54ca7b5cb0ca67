from __future__ import annotations

import numpy as np
import pytest
import torch
from random_poses import cameras, rigid

from gvtools.cameras import Cameras, invert_rigid
from gvtools.completers.geoverse.camera_encoding import (
    CENTRED,
    GLD_PIXEL_OFFSET,
    camera_condition,
    normalised_poses,
    plucker_map,
)

SIZE = (14, 28)


def test_rays_through_pixel_centres_are_those_of_the_cameras():
    pose, K = cameras()
    found = plucker_map(pose, K, SIZE, pixel_offset=CENTRED)
    for b, view in np.ndindex(2, 3):
        numpy = Cameras(
            K[b, view].numpy()[None], invert_rigid(pose[b, view].numpy())[None],
            np.array([SIZE[1]]), np.array([SIZE[0]]),
            ("a",),
        )  # fmt: skip
        np.testing.assert_allclose(
            np.moveaxis(found[b, view].numpy(), 0, -1), numpy.plucker(), rtol=1e-9, atol=1e-9
        )


def test_the_published_offset_is_a_principal_point_one_pixel_to_the_right():
    pose, K = cameras()
    moved = K.clone()
    moved[..., 0, 2] += 1
    torch.testing.assert_close(
        plucker_map(pose, K, SIZE, pixel_offset=GLD_PIXEL_OFFSET),
        plucker_map(pose, moved, SIZE, pixel_offset=CENTRED),
    )


def test_the_moment_is_that_of_any_point_of_the_ray():
    pose, K = cameras()
    direction, moment = plucker_map(pose, K, SIZE).split(3, dim=2)
    torch.testing.assert_close(direction.norm(dim=2), torch.ones(2, 3, *SIZE).double())
    point = pose[..., :3, 3, None, None] + 2.5 * direction
    torch.testing.assert_close(torch.linalg.cross(point, direction, dim=2), moment)


@pytest.mark.parametrize("reference", [-1, 0])
def test_poses_are_relative_and_the_farthest_component_is_one(reference):
    pose, _ = cameras()
    rebased, scale = normalised_poses(pose, reference=reference)
    torch.testing.assert_close(rebased[:, reference], torch.eye(4).double().expand(2, 4, 4))
    torch.testing.assert_close(
        rebased[..., :3, 3].abs().amax(dim=(1, 2)), torch.ones(2).double(), rtol=0, atol=1e-7
    )
    expected = torch.linalg.inv(pose[:, reference, None]) @ pose
    expected[..., :3, 3] *= scale[:, None, None]
    torch.testing.assert_close(rebased, expected)


def test_no_similarity_of_the_world_changes_them():
    pose, _ = cameras()
    moved = rigid(1, seed=4, reach=10.0)[0] @ pose
    moved[..., :3, 3] *= 7.5
    rebased, scale = normalised_poses(pose)
    other, smaller = normalised_poses(moved)
    torch.testing.assert_close(other, rebased, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(smaller * 7.5, scale, rtol=1e-7, atol=1e-7)


def test_views_far_from_the_origin_keep_their_digits():
    pose, _ = cameras()
    far = pose.clone()
    far[..., :3, 3] += torch.tensor([4e5, 5.5e6, 1e2]).double()
    torch.testing.assert_close(
        normalised_poses(far)[0], normalised_poses(pose)[0], rtol=1e-7, atol=1e-7
    )
    near = far.float()
    near[..., :3, 3] = pose[..., :3, 3].float() + 512
    torch.testing.assert_close(
        normalised_poses(near)[0].double(), normalised_poses(pose)[0], rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("where", [0.0, 123.456])
def test_a_turning_camera_has_no_scale_to_blow_up(where, dtype):
    pose = rigid(4, reach=0.0)[None].to(dtype)
    pose[..., :3, 3] = where
    rebased, scale = normalised_poses(pose)
    assert scale.tolist() == [1.0]
    assert not rebased[..., :3, 3].any()
    K = cameras(1, 4, dtype)[1]
    assert camera_condition(pose, K, SIZE, context=1).map.isfinite().all()


def test_the_condition_of_views():
    pose, K = cameras()
    condition = camera_condition(pose, K, SIZE, context=2)
    rebased, scale = normalised_poses(pose)
    assert condition.map.shape == (2, 3, 7, *SIZE) and condition.context == 2
    assert [view.unique().tolist() for view in condition.map[0, :, 0]] == [[0.0], [0.0], [1.0]]
    torch.testing.assert_close(
        condition.map[:, :, 1:], plucker_map(rebased, K, SIZE, pixel_offset=GLD_PIXEL_OFFSET)
    )
    # Relative poses of what PRoPE gets are those of the map.
    between = condition.cam_from_world[:, 0] @ torch.linalg.inv(condition.cam_from_world[:, 2])
    expected = torch.linalg.inv(rebased[:, 0]) @ rebased[:, 2]
    torch.testing.assert_close(between, expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(condition.scale, scale)


@pytest.mark.parametrize(
    ("mode", "poses", "intrinsics"),
    [("new", False, False), ("old", False, True), ("old_train", True, False)],
)
def test_without_cameras_only_the_mask_and_what_the_mode_keeps_is_left(mode, poses, intrinsics):
    pose, K = cameras()
    given = camera_condition(pose, K, SIZE, context=1)
    bare = given.unconditional(mode)
    torch.testing.assert_close(bare.map[:, :, 0], given.map[:, :, 0])
    assert not bare.map[:, :, 1:].any()
    kept = given.cam_from_world if poses else torch.eye(4).double().expand(2, 3, 4, 4)
    torch.testing.assert_close(bare.cam_from_world, kept)
    kept = given.K if intrinsics else torch.eye(3).double().expand(2, 3, 3, 3)
    torch.testing.assert_close(bare.K, kept)
    assert given.map[:, :, 1:].any()


def test_autocast_and_half_precision_leave_the_map_in_single():
    pose, K = cameras(dtype=torch.float32)
    exact = camera_condition(pose, K, SIZE, context=1)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under = camera_condition(pose, K, SIZE, context=1)
    torch.testing.assert_close(under.map, exact.map, rtol=0, atol=0)
    torch.testing.assert_close(under.cam_from_world, exact.cam_from_world, rtol=0, atol=0)
    half = camera_condition(pose.bfloat16(), K.bfloat16(), SIZE, context=1)
    assert half.map.dtype == half.cam_from_world.dtype == torch.float32


def test_gradients():
    pose, K = cameras(1, 2)

    def through(pose, K):
        rebased, scale = normalised_poses(pose)
        return plucker_map(rebased, K, (2, 3)), scale

    inputs = (pose.requires_grad_(), K.requires_grad_())
    assert torch.autograd.gradcheck(through, inputs, fast_mode=True)
