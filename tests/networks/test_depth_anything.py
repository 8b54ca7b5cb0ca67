from __future__ import annotations

from dataclasses import replace

import geoverse_models as micro
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks.experiments.poses import nearest_rotation, poses_least_squares
from gvtools.completers.geoverse.conditioning import HintConfig, ViewBatch, encode_views
from gvtools.errors import DegenerateError
from gvtools.networks.depth_anything.encoder import patch_rays
from gvtools.networks.depth_anything.geometry_head import camera_centres
from gvtools.networks.depth_anything.network import DepthAnything3

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE = (84, 112)
GRID = (24, 32)


def poses(views: int, *, seed: int = 0, tilt: float = 0.5) -> np.ndarray:
    """World-from-camera, the first the identity, turned by up to ``tilt`` radians."""
    rng = np.random.default_rng(seed)
    pose = np.tile(np.eye(4), (views, 1, 1))
    axis = rng.normal(size=(views - 1, 3))
    axis *= rng.uniform(0, tilt, (views - 1, 1)) / np.linalg.norm(axis, axis=1, keepdims=True)
    pose[1:, :3, :3] = Rotation.from_rotvec(axis).as_matrix()
    pose[1:, :3, 3] = rng.uniform(-2, 2, (views - 1, 3))
    return pose


def intrinsics(*, centred: bool) -> np.ndarray:
    middle = (56, 42) if centred else (61, 37)
    return np.array([[100, 0, middle[0]], [0, 95, middle[1]], [0, 0, 1]], float)


def ray_map(pose: np.ndarray, K: np.ndarray, *, grid=GRID, seed=1) -> torch.Tensor:
    """Exact rays through the cells' centres; each view's directions have their own length."""
    y = (np.arange(grid[0]) + 0.5) * SIZE[0] / grid[0]
    x = (np.arange(grid[1]) + 0.5) * SIZE[1] / grid[1]
    pixel = np.stack(np.broadcast_arrays(x[None], y[:, None], 1.0), -1)
    length = np.random.default_rng(seed).uniform(0.5, 2, (len(pose), 1, 1, 1))
    direction = np.einsum("vij,jk,yxk->vyxi", pose[:, :3, :3], np.linalg.inv(K), pixel) * length
    origin = np.broadcast_to(pose[:, None, None, :3, 3], direction.shape)
    return torch.from_numpy(np.concatenate([direction, origin], -1))


def noisy(ray: torch.Tensor, level: float, *, seed: int = 2) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return ray + torch.from_numpy(rng.normal(0, level, tuple(ray.shape)))


@pytest.mark.parametrize("subsample", [1, 3, 4])
@pytest.mark.parametrize("centred", [True, False])
def test_least_squares_is_exact_on_exact_rays(centred, subsample):
    pose, K = poses(4), intrinsics(centred=centred)
    found = poses_least_squares(ray_map(pose, K), size=SIZE, subsample=subsample, cell_offset=0.5)
    np.testing.assert_allclose(found.world_from_cam, pose, atol=1e-9)
    np.testing.assert_allclose(found.K, np.tile(K, (4, 1, 1)), atol=1e-6)


def test_the_published_cells_move_the_principal_point_by_half_a_cell():
    ray = ray_map(poses(3), intrinsics(centred=False))
    published, ours = (poses_least_squares(ray, size=SIZE, cell_offset=c) for c in (0.0, 0.5))
    torch.testing.assert_close(published.world_from_cam, ours.world_from_cam)
    shift = (ours.K - published.K)[..., :2, 2]
    np.testing.assert_allclose(shift, np.tile([1.75, 1.75], (3, 1)), atol=1e-6)


def test_weights_multiply_the_equations():
    ray = noisy(ray_map(poses(3), intrinsics(centred=False)), 0.05).numpy()
    weight = np.random.default_rng(3).uniform(0.1, 5, ray.shape[:-1])
    found = poses_least_squares(torch.from_numpy(ray), torch.from_numpy(weight), size=SIZE)
    fits = []
    for view in range(3):
        left, right = [], []
        for y in range(0, GRID[0], 4):
            for x in range(0, GRID[1], 4):
                left.append(weight[view, y, x] * np.array([x, y, 1.0]))
                right.append(weight[view, y, x] * ray[view, y, x, :3])
        fits.append(np.linalg.lstsq(np.array(left), np.array(right), rcond=None)[0].T)
    K = np.linalg.inv(fits[0])
    scale = np.diag([SIZE[1] / GRID[1], SIZE[0] / GRID[0], 1])
    np.testing.assert_allclose(found.K[1], scale @ K / K[2, 2], rtol=1e-9)
    for view in range(3):
        u, _, vt = np.linalg.svd(fits[view] @ K)
        np.testing.assert_allclose(found.world_from_cam[view, :3, :3], u @ vt, atol=1e-9)
        mean = np.average(ray[view, ..., 3:].reshape(-1, 3), axis=0, weights=weight[view].ravel())
        np.testing.assert_allclose(found.world_from_cam[view, :3, 3], mean, rtol=1e-9)


def test_wrong_rays_weigh_nothing_where_no_confidence_is():
    pose, K = poses(3), intrinsics(centred=True)
    ray = noisy(ray_map(pose, K), 1e-3)
    rng = np.random.default_rng(4)
    wrong = torch.from_numpy(rng.random(ray.shape[:-1]) < 0.3)
    damaged = ray.clone()
    damaged[..., :3][wrong] = torch.from_numpy(rng.normal(size=(int(wrong.sum()), 3)))
    plain = poses_least_squares(damaged, size=SIZE)
    assert np.abs(plain.world_from_cam.numpy() - pose)[:, :3, :3].max() > 0.02
    confident = poses_least_squares(damaged, (~wrong).double(), size=SIZE)
    np.testing.assert_allclose(confident.world_from_cam[:, :3, :3], pose[:, :3, :3], atol=5e-3)


def test_a_batch_gives_what_its_parts_give():
    ray = noisy(ray_map(poses(4), intrinsics(centred=True)), 0.02)
    batch = ray.unflatten(0, (2, 2))
    whole = poses_least_squares(batch, size=SIZE)
    assert whole.world_from_cam.shape == (2, 2, 4, 4) and whole.K.shape == (2, 2, 3, 3)
    second = poses_least_squares(batch[1], size=SIZE)
    torch.testing.assert_close(whole.world_from_cam[1], second.world_from_cam)
    torch.testing.assert_close(whole.K[1], second.K)


def test_centres_are_weighted_means_and_pass_gradients():
    ray = noisy(ray_map(poses(3), intrinsics(centred=True)), 0.1)
    weight = torch.from_numpy(np.random.default_rng(8).uniform(1, 4, ray.shape[:-1]))
    found = camera_centres(ray, weight)
    expected = [
        np.average(r[..., 3:].reshape(-1, 3), axis=0, weights=w.ravel())
        for r, w in zip(ray.numpy(), weight.numpy(), strict=True)
    ]
    np.testing.assert_allclose(found, expected)
    torch.testing.assert_close(camera_centres(ray), camera_centres(ray, torch.full_like(weight, 7)))
    torch.testing.assert_close(camera_centres(ray[None], weight[None])[0], found)
    small = (ray[:, :2, :3].clone().requires_grad_(), weight[:, :2, :3].clone().requires_grad_())
    assert torch.autograd.gradcheck(camera_centres, small)


def test_the_nearest_rotation_is_scipys():
    rng = np.random.default_rng(9)
    matrices = Rotation.random(5, random_state=1).as_matrix() + rng.normal(0, 0.1, (5, 3, 3))
    matrices[0] = np.diag([1.0, 1.0, -0.2])
    found = nearest_rotation(torch.from_numpy(matrices)).numpy()
    np.testing.assert_allclose(np.linalg.det(found), 1)
    for matrix, rotation in zip(matrices, found, strict=True):
        distance = np.linalg.norm(matrix - rotation)
        for near in Rotation.from_rotvec(rng.normal(0, 0.05, (20, 3))).as_matrix():
            assert distance <= np.linalg.norm(matrix - near @ rotation) + 1e-12


def test_rays_that_hold_no_camera():
    ray = ray_map(poses(2), intrinsics(centred=True))
    equal = ray.clone()
    equal[1, ..., :3] = torch.tensor([0.1, 0.2, 1.0]).double()
    with pytest.raises(DegenerateError):
        poses_least_squares(equal, size=SIZE)
    with pytest.raises(DegenerateError, match="NaN"):
        poses_least_squares(ray * np.nan, size=SIZE)
    with pytest.raises(DegenerateError, match="confidences"):
        poses_least_squares(ray, torch.zeros(ray.shape[:-1]), size=SIZE)
    with pytest.raises(DegenerateError, match="negative"):
        camera_centres(ray, -torch.ones(ray.shape[:-1]))


TOLD = HintConfig(cameras=True, camera_unit="depth")


@pytest.fixture(scope="module")
def batch() -> ViewBatch:
    return micro.batch(context=2, targets=1)


def network(*, rays: bool) -> DepthAnything3:
    torch.manual_seed(0)
    config = micro.CONFIG.geometry
    return DepthAnything3(replace(config, encoder=replace(config.encoder, rays=rays))).eval()


def scaled(batch: ViewBatch, factor: float, *, depth: bool = True) -> ViewBatch:
    pose = batch.cam_from_world.clone()
    pose[..., :3, 3] *= factor
    return replace(batch, cam_from_world=pose, depth=batch.depth * (factor if depth else 1))


def test_patch_rays_pass_through_their_patches(batch):
    grid, size = (3, 4), (24, 32)
    rays = patch_rays(batch.cam_from_world, batch.K, grid, size=size)
    direction, origin, moment = rays.split(3, dim=-1)
    assert rays.shape == (*batch.K.shape[:2], 12, 9)
    point = origin + 2.5 * direction
    pose = batch.cam_from_world
    seen = torch.einsum("bvij,bvnj->bvni", pose[..., :3, :3], point) + pose[:, :, None, :3, 3]
    assert torch.allclose(seen[..., 2], torch.full_like(seen[..., 2], 2.5), atol=1e-5)
    pixel = torch.einsum("bvij,bvnj->bvni", batch.K, seen / seen[..., 2:])[..., :2]
    assert torch.allclose(pixel[..., 0, :], torch.tensor([4.0, 4.0]), atol=1e-3)
    assert torch.allclose(pixel[..., 11, :], torch.tensor([28.0, 20.0]), atol=1e-3)
    assert torch.allclose(moment, torch.linalg.cross(point, direction), atol=1e-5)


def test_features_depend_on_rays_and_not_on_the_worlds_unit(batch):
    plain, told = network(rays=False), network(rays=True)
    with torch.no_grad():
        first = encode_views(told, batch, slice(None), config=TOLD)[1]
        again = encode_views(told, scaled(batch, 40.0), slice(None), config=TOLD)[1]
        nearer = encode_views(told, scaled(batch, 0.3, depth=False), slice(None), config=TOLD)[1]
        silent = encode_views(told, batch, slice(None), config=HintConfig(cameras=False))[1]
    assert torch.allclose(first, again, rtol=1e-3, atol=1e-4)
    assert not torch.allclose(first, nearer, rtol=1e-2, atol=1e-3)
    assert not torch.allclose(first, silent, rtol=1e-2, atol=1e-3)
    extra = set(told.state_dict()) - set(plain.state_dict())
    assert {name.split("ray_embed.")[-1] for name in extra} == {"weight", "bias"}


def test_without_any_depth_the_unit_is_that_of_the_centres(batch):
    told = network(rays=True)
    blind = replace(batch, depth=torch.zeros_like(batch.depth))
    with torch.no_grad():
        first = encode_views(told, blind, slice(None), config=TOLD)[1]
        median = encode_views(told, blind, slice(None), config=HintConfig(cameras=True))[1]
    assert torch.isfinite(first).all()
    assert torch.equal(first, median)
