from __future__ import annotations

from dataclasses import replace

import geoverse_models as micro
import numpy as np
import pytest
import torch

from gvtools.cameras import Cameras
from gvtools.completers import ContextView
from gvtools.completers.geoverse.views import model_size, view_batch


def blob(camera: Cameras, point: np.ndarray, sigma: float) -> np.ndarray:
    (((x, y),),), _ = camera.project(point[None])
    columns = np.arange(int(camera.width[0])) + 0.5
    rows = np.arange(int(camera.height[0]))[:, None] + 0.5
    dot = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return np.repeat(dot[..., None], 3, axis=2).astype(np.float32)


@pytest.mark.parametrize(
    ("context_size", "target_size"),
    [
        ((120, 160), (120, 160)),
        ((200, 90), (120, 160)),
        ((150, 150), (160, 100)),
        ((61, 83), (77, 77)),
    ],
)  # fmt: skip
def test_cameras_follow_pictures_that_are_cropped_and_resized(context_size, target_size):
    point = np.array([0.05, -0.1, 3.2])
    views = []
    for seed in range(2):
        camera = micro.cameras(1, size=context_size, seed=seed)
        rgb = blob(camera, point, max(context_size) / 20)
        views.append(ContextView(f"photo_{seed}", camera, rgb))
    cameras = micro.cameras(2, size=target_size, seed=5)
    known = micro.guidance(2, size=target_size, share=1.1)
    dots = np.stack([blob(camera, point, max(target_size) / 20) for camera in cameras])
    known = replace(known, cameras=cameras, rgb=dots)
    size = model_size(*target_size, longest=96, patch=8)
    batch, joined = view_batch(views, known, size)
    assert (
        batch.size == size and (joined.height == size[0]).all() and (joined.width == size[1]).all()
    )
    local = joined.cam_from_world[0] @ np.append(point, 1)
    unit = np.linalg.norm(joined.centers - joined.centers[0], axis=1).max()
    world = torch.from_numpy(np.append(local[:3] / unit, 1)).float()
    seen = (batch.cam_from_world[0] @ world)[:, :3]
    pixel = torch.einsum("vij,vj->vi", batch.K[0], seen / seen[:, 2:])[:, :2].numpy()
    expected, _ = joined.project(point[None])
    np.testing.assert_allclose(pixel, expected[:, 0], atol=1e-3)
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    for view in range(4):
        dot = batch.images[0, view, 0].double().numpy() ** 2  # the tails are cut off at the rim
        centroid = np.array([(dot * x).sum(), (dot * y).sum()]) / dot.sum()
        np.testing.assert_allclose(centroid, pixel[view], atol=0.15)


@pytest.mark.parametrize("size", [(24, 32), (16, 24), (48, 64), (72, 40)])
def test_projected_depth_is_never_averaged_between_two_surfaces(size):
    rng = np.random.default_rng(0)
    known = micro.guidance(2, share=0.7)
    depth = np.where(rng.random(known.depth.shape) < 0.5, 1.0, 5.0).astype(np.float32)
    depth *= known.valid
    context = micro.context_views(1)
    wall = np.where(rng.random((30, 40)) < 0.5, 2.0, 8.0).astype(np.float32)
    context = [replace(context[0], depth=wall)]
    batch, joined = view_batch(context, replace(known, depth=depth), size)
    unit = np.linalg.norm(joined.centers - joined.centers[0], axis=1).max()
    found = batch.depth[0].numpy() * unit
    for views, surfaces in ((found[:1], (2, 8)), (found[1:], (0, 1, 5))):
        gap = np.min([np.abs(views - surface) for surface in surfaces], axis=0)
        assert gap.max() < 1e-5
        assert all((np.abs(views - surface) < 1e-5).any() for surface in surfaces)
    assert torch.equal(batch.valid[0, 1:], batch.depth[0, 1:] > 0)
    assert batch.valid[0, 0].all()


def test_a_projections_colour_is_that_of_its_valid_pixels_alone():
    known = micro.guidance(1, size=(48, 64), share=0.8)
    red = np.zeros_like(known.rgb)
    red[..., 0] = 0.75
    damaged = replace(
        known,
        rgb=np.where(known.valid[..., None], red, np.float32(np.nan)),
        depth=np.where(known.valid, known.depth, np.float32(np.nan)),
    )
    batch, _ = view_batch(micro.context_views(1), damaged, (24, 32))
    seen = batch.valid[0, 1, 0]
    assert 0.5 < seen.float().mean() < 1
    colour = batch.images[0, 1]
    torch.testing.assert_close(colour[0][seen], torch.full_like(colour[0][seen], 0.75))
    assert not colour[1:].any() and not colour[:, ~seen].any()
    assert batch.depth.isfinite().all()
