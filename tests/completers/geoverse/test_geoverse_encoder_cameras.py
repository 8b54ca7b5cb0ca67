"""What the encoder is told of known cameras."""

from __future__ import annotations

from dataclasses import replace

import geoverse_models as micro
import pytest
import torch

from gvtools.completers.geoverse.conditioning import HintConfig, ViewBatch, encode_views
from gvtools.networks.depth_anything.encoder import patch_rays
from gvtools.networks.depth_anything.network import DepthAnything3

pytestmark = pytest.mark.usefixtures("one_thread")
TOLD = HintConfig(cameras=True, camera_unit="depth")


@pytest.fixture(scope="module")
def batch() -> ViewBatch:
    return micro.batch(context=2, targets=1)


def network(*, rays: bool) -> DepthAnything3:
    torch.manual_seed(0)
    config = micro.CONFIG.geometry
    return DepthAnything3(replace(config, encoder=replace(config.encoder, rays=rays))).eval()


def scaled(batch: ViewBatch, factor: float, *, depth: bool = True) -> ViewBatch:
    """The same views in another unit."""
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
