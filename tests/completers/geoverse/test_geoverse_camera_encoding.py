from __future__ import annotations

import numpy as np
import pytest
import torch
from random_poses import cameras, rigid

from gvtools.cameras import Cameras, invert_rigid
from gvtools.completers.geoverse.camera_encoding import (
    CENTRED,
    GLD_PIXEL_OFFSET,
    Projective,
    camera_condition,
    normalised_poses,
    plucker_map,
)
from gvtools.networks.compute import attend

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


PICTURE = (84, 112)
GRID = (3, 4)


def tokens(head_dim: int, *, batch=2, views=3, heads=2, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, heads, views * GRID[0] * GRID[1], head_dim)
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)


def lifted(pose, K, size=PICTURE):
    """K in shares of the image, and the 4x4 it becomes, element by element."""
    shares = torch.zeros_like(pose)
    shares[..., 0, 0], shares[..., 1, 1] = K[..., 0, 0] / size[1], K[..., 1, 1] / size[0]
    shares[..., 0, 2] = K[..., 0, 2] / size[1] - 0.5
    shares[..., 1, 2] = K[..., 1, 2] / size[0] - 0.5
    shares[..., 2, 2] = shares[..., 3, 3] = 1
    return shares


def dense(matrix: np.ndarray, y: int, x: int, head_dim: int, *, base: float = 100.0) -> np.ndarray:
    """The whole head_dim x head_dim transform of one token."""
    groups = head_dim // 8
    out = np.zeros((head_dim, head_dim))
    for group in range(groups):
        out[4 * group : 4 * group + 4, 4 * group : 4 * group + 4] = matrix
    start = head_dim // 2
    for position in (x, y):
        for i in range(groups):
            angle = position * base ** (-i / groups)
            a, b = start + i, start + groups + i
            out[a, a] = out[b, b] = np.cos(angle)
            out[a, b], out[b, a] = np.sin(angle), -np.sin(angle)
        start += head_dim // 4
    return out


@pytest.mark.parametrize("head_dim", [8, 24])
def test_every_token_is_transformed_as_the_definition_says(head_dim):
    pose, K = cameras()
    encoding = Projective(pose, K, PICTURE, grid=GRID, head_dim=head_dim)
    P = (lifted(pose, K) @ pose).numpy()
    x = tokens(head_dim)
    found = [f(x).numpy() for f in (encoding.query, encoding.key, encoding.value, encoding.output)]
    count = GRID[0] * GRID[1]
    for b, view, row, column in np.ndindex(2, 3, *GRID):
        token = view * count + row * GRID[1] + column
        inverse = np.linalg.inv(P[b, view])
        forward = [dense(m, row, column, head_dim) for m in (P[b, view].T, inverse, inverse)]
        # The result's rotation is the inverse of the others'.
        backward = dense(P[b, view], -row, -column, head_dim)
        for ours, transform in zip(found, [*forward, backward], strict=True):
            np.testing.assert_allclose(
                ours[b, :, token], x[b, :, token].numpy() @ transform.T, rtol=1e-9, atol=1e-9
            )


@pytest.mark.parametrize("invert_K", [True, False])
def test_the_world_frame_does_not_matter_and_a_moved_camera_does(invert_K):
    pose, K = cameras()
    q, k, v = (tokens(24, seed=seed) for seed in range(3))
    other = pose.clone()
    other[:, 1, 0, 3] += 0.5
    results = []
    for poses in (pose, pose @ rigid(1, seed=9, reach=3.0)[0], other):
        e = Projective(poses, K, PICTURE, grid=GRID, head_dim=24, invert_K=invert_K)
        results.append(e.output(attend(e.query(q), e.key(k), e.value(v))))
    torch.testing.assert_close(results[0], results[1], rtol=1e-9, atol=1e-9)
    assert (results[0] - results[2]).abs().max() > 1e-2


def test_keys_of_a_coarser_grid_lie_at_the_centres_of_their_tokens():
    pose, K = cameras(1, 1)
    coarse = Projective(pose, K, PICTURE, grid=(1, 2), head_dim=8, position_scale=(3.0, 2.0))
    # Columns 0, 1 have their middle at 0.5, columns 2, 3 at 2.5; rows 0 to 2 at 1.
    x, y = torch.tensor([0.5, 2.5]).double(), torch.ones(2).double()
    torch.testing.assert_close(coarse.cos[:, :, 0], torch.stack((x, y), -1).cos())
    torch.testing.assert_close(coarse.sin[:, :, 0], torch.stack((x, y), -1).sin())
    fine = Projective(pose, K, PICTURE, grid=GRID, head_dim=8)
    torch.testing.assert_close(coarse.key_matrix, fine.key_matrix)


def test_half_precision_rounds_the_result_only():
    pose, K = cameras(dtype=torch.float32)
    encoding = Projective(pose, K, PICTURE, grid=GRID, head_dim=24)
    assert encoding.matrix.dtype == encoding.cos.dtype == torch.float32
    x = tokens(24, dtype=torch.bfloat16)
    for method in (encoding.query, encoding.key, encoding.value, encoding.output):
        low = method(x)
        assert low.dtype == torch.bfloat16
        torch.testing.assert_close(low, method(x.float()).bfloat16(), rtol=0, atol=0)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            under = method(x.float())
        torch.testing.assert_close(under, method(x.float()), rtol=0, atol=0)
