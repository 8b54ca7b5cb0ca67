from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import geoverse_models as micro
import numpy as np
import pytest
import torch
from torch import Tensor

from gvtools.cameras import Cameras
from gvtools.completers import ContextView
from gvtools.completers.geoverse.conditioning import (
    LOG_DEPTH_LIMIT,
    HintConfig,
    Hints,
    LatentStatistics,
    ViewBatch,
    depth_condition,
    encode_hints,
    feature_mask,
    fill_holes,
)
from gvtools.completers.geoverse.denoiser import Conditions, DenoiserBlock
from gvtools.completers.geoverse.views import model_size, view_batch

PAPER = HintConfig()
KNOWN_CAMERAS = HintConfig(cameras=True)


@pytest.fixture(scope="module")
def model() -> Any:
    return micro.model()


def hints(model: Any, batch: ViewBatch, config: HintConfig = PAPER) -> Hints:
    level0, level1 = model.statistics
    return encode_hints(model.geometry, level0, level1, batch=batch, config=config)


def with_valid(batch: ViewBatch, valid: Tensor) -> ViewBatch:
    """Context stays known; the rest becomes what ``valid`` says, (B, T, 1, H, W)."""
    valid = torch.cat((batch.valid[:, : batch.context], valid), dim=1)
    images, depth = batch.images * valid, batch.depth * valid
    return replace(batch, images=images, depth=depth, valid=valid)


def no_target(batch: ViewBatch) -> ViewBatch:
    return with_valid(batch, torch.zeros_like(batch.valid[:, batch.context :]))


def alone(model: Any, batch: ViewBatch) -> list[Tensor]:
    """Normalised levels 0 and 1 of the context views, with no other view in sight."""
    raw = model.geometry.encode(batch.images[:, : batch.context], levels=2)
    return [
        statistics.normalise(level[:, :, 1:].mT.unflatten(3, micro.GRID))
        for statistics, level in zip(model.statistics, raw, strict=True)
    ]


def close(found: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_an_empty_hint_is_zero_padding_bit_for_bit(model):
    batch = no_target(micro.batch(2, context=2, targets=3))
    found = hints(model, batch)
    level0, level1 = alone(model, batch)
    for padded, context in ((found.level1, level1), (found.unmasked, level1)):
        assert torch.equal(padded[:, :2], context)
        assert torch.equal(padded[:, 2:], torch.zeros_like(padded[:, 2:]))
    assert torch.equal(found.level0[:, :2], level0)
    assert not found.level0[:, 2:].any()
    assert found.mask[:, :2].all() and not found.mask[:, 2:].any()


@pytest.mark.parametrize("fill", ["none", "push-pull"])
@torch.no_grad()
def test_scattered_pixels_that_fill_no_token_are_an_empty_hint_too(model, fill):
    batch = micro.batch(1)
    few = torch.zeros_like(batch.valid[:, 2:])
    few[..., ::4, ::4] = True
    sparse = with_valid(batch, few)
    config = HintConfig(fill=fill)
    found = hints(model, fill_holes(sparse, config), config)
    expected = hints(model, no_target(batch))
    for name in ("level1", "unmasked", "level0", "token", "mask"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    # With no threshold their picture counts.
    config = replace(config, mask=0.0)
    assert hints(model, fill_holes(sparse, config), config).level1[:, 2:].any()


@torch.no_grad()
def test_context_and_projections_are_encoded_jointly_and_masked_after_normalisation(model):
    batch = micro.batch(2)
    found = hints(model, batch)
    raw = model.geometry.encode(batch.images, levels=2)[1][:, :, 1:]
    joint = model.statistics[1].normalise(raw.mT.unflatten(3, micro.GRID))
    mask = feature_mask(batch.valid, micro.GRID, 0.5)
    assert 0 < mask[:, 2:].mean() < 1
    close(found.unmasked, joint)
    assert torch.equal(found.mask, mask)
    assert torch.equal(found.level1, found.unmasked * mask)
    # Projections are seen by the context, too.
    assert (joint[:, :2] - alone(model, batch)[1]).abs().max() > 0.01


def test_a_token_counts_from_its_share_of_valid_pixels_on():
    valid = torch.zeros(1, 1, 1, *micro.SIZE, dtype=torch.bool)
    pixels = micro.PATCH**2
    counts = torch.arange(micro.GRID[0] * micro.GRID[1]) * 5 % (pixels + 1)
    counts[3], counts[4], counts[5], counts[6] = 32, 31, 64, 63
    for token, count in enumerate(counts.tolist()):
        row, column = divmod(token, micro.GRID[1])
        window = torch.zeros(pixels, dtype=torch.bool)
        window[:count] = True
        top, left = row * micro.PATCH, column * micro.PATCH
        valid[0, 0, 0, top : top + micro.PATCH, left : left + micro.PATCH] = window.view(8, 8)
    for share in (0.0, 1 / pixels, 0.25, 0.5, 63 / 64, 1.0):
        mask = feature_mask(valid, micro.GRID, share)
        assert mask.shape == (1, 1, 1, *micro.GRID) and mask.dtype == torch.float32
        expected = counts >= math.ceil(share * pixels - 1e-9)
        assert torch.equal(mask.flatten() > 0, expected), share


@pytest.mark.parametrize("config", [PAPER, KNOWN_CAMERAS, HintConfig(token="own", mask=0.0)])
@torch.no_grad()
def test_views_that_tell_nothing_do_not_disturb_the_others(model, config):
    batch = micro.batch(1, context=2, targets=3)
    valid = batch.valid[:, 2:].clone()
    valid[:, 1] = False
    silent = with_valid(batch, valid)
    rest = [0, 1, 2, 4]
    without = ViewBatch(
        silent.images[:, rest], silent.depth[:, rest], silent.valid[:, rest],
        silent.cam_from_world[:, rest], silent.K[:, rest], 2,
    )  # fmt: skip
    found = hints(model, silent, config)
    assert not found.level1[:, 3].any() and not found.unmasked[:, 3].any()
    if not config.cameras:  # the unit of the cameras is that of all views
        expected = hints(model, without, config)
        for name in ("level1", "unmasked", "level0", "token"):
            close(getattr(found, name)[:, rest], getattr(expected, name))
    noisy = replace(silent, images=silent.images.clone())
    noisy.images[:, 3] = 0.7
    again = hints(model, noisy, config)
    assert torch.equal(again.level1, found.level1) and torch.equal(again.token, found.token)


@pytest.mark.parametrize("encode", ["jointly", "alone"])
@pytest.mark.parametrize("token", ["first-context", "own"])
@pytest.mark.parametrize("cameras", [False, True])
@torch.no_grad()
def test_samples_with_different_gaps_are_as_each_by_itself(model, encode, token, cameras):
    batch = micro.batch(5, context=2, targets=2)
    valid = batch.valid[:, 2:].clone()
    for sample, silent in enumerate(((), (0,), (1,), (0, 1), (0,))):
        valid[sample, list(silent)] = False
    batch = with_valid(batch, valid)
    config = HintConfig(encode=encode, token=token, cameras=cameras, cascade_context="jointly")
    whole = hints(model, batch, config)
    for sample in range(5):
        part = hints(model, batch.samples(torch.tensor([sample])), config)
        for name in ("level1", "unmasked", "level0", "token", "mask"):
            close(getattr(whole, name)[sample], getattr(part, name)[0])


@torch.no_grad()
def test_encoded_alone_the_context_does_not_see_the_projections(model):
    batch = micro.batch(1)
    found = hints(model, batch, HintConfig(encode="alone"))
    joint = hints(model, batch)
    close(found.level1[:, :2], alone(model, batch)[1])
    assert torch.equal(found.level1[:, 2:], joint.level1[:, 2:])


@torch.no_grad()
def test_level_0_of_the_context_comes_from_where_it_is_asked_for(model):
    batch = micro.batch(1)
    joint = model.geometry.encode(batch.images, levels=1)[0][:, :2, 1:]
    expected = model.statistics[0].normalise(joint.mT.unflatten(3, micro.GRID))
    jointly = HintConfig(cascade_context="jointly")
    for config, level in ((HintConfig(), alone(model, batch)[0]), (jointly, expected)):
        found = hints(model, batch, config).level0
        close(found[:, :2], level)
        assert not found[:, 2:].any()
    assert (expected - alone(model, batch)[0]).abs().max() > 0.01


@pytest.mark.parametrize("context", [1, 2])
@torch.no_grad()
def test_token_0_is_the_first_context_views_alone(model, context):
    batch = micro.batch(2, context=context, targets=2)
    first = model.geometry.encode(batch.images[:, :1], levels=2)[1][:, :, 0]
    found = hints(model, batch).token
    close(found, first.expand_as(found))
    own = hints(model, batch, HintConfig(token="own")).token
    close(own, model.geometry.encode(batch.images, levels=2)[1][:, :, 0])
    silent = hints(model, no_target(batch), HintConfig(token="own")).token
    mean = silent[:, :context].mean(1, keepdim=True)
    close(silent[:, context:], mean.expand_as(silent[:, context:]))


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@torch.no_grad()
def test_known_cameras_count_relative_to_each_other_alone(model, factor):
    batch = micro.batch(1)
    expected = hints(model, batch, KNOWN_CAMERAS)
    assert (expected.unmasked - hints(model, batch).unmasked).abs().max() > 0.01
    world = torch.eye(4)
    world[:3, :3] = torch.from_numpy(micro.rotation((1, -2, 0.5), 1.1)).float()
    poses = batch.cam_from_world.clone()
    poses[..., :3, 3] *= factor
    found = hints(model, replace(batch, cam_from_world=poses @ world), KNOWN_CAMERAS)
    close(found.unmasked, expected.unmasked)
    turned = batch.cam_from_world.clone()
    turned[:, 1] = turned[:, 2]
    other = hints(model, replace(batch, cam_from_world=turned), KNOWN_CAMERAS)
    assert (other.unmasked - expected.unmasked).abs().max() > 0.01


def test_depth_is_told_as_its_logarithm_in_the_cameras_unit():
    nan, inf = math.nan, math.inf
    depth = torch.tensor([2.0, nan, inf, -1.0, 0.0, 5.0, 1e9, 1e-9, 1.0]).view(1, 1, 1, 1, 9)
    valid = torch.ones(1, 1, 1, 1, 9, dtype=torch.bool)
    valid[..., 5] = False
    found = depth_condition(depth, valid, torch.tensor([0.5]))
    limit = LOG_DEPTH_LIMIT
    log = [0, 0, 0, 0, 0, 0, limit, -limit, math.log(0.5)]
    torch.testing.assert_close(found[0, 0, 0, 0], torch.tensor(log))
    assert found[0, 0, 1, 0].tolist() == [1, 0, 0, 0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize("fill", ["none", "push-pull"])
@torch.no_grad()
def test_what_stands_in_the_holes_of_depth_does_not_matter(fill):
    net = micro.model(micro.config(hints={"fill": fill}))
    batch = micro.batch(1)
    expected = net.prepare(batch)
    damaged = torch.where(batch.valid, batch.depth, torch.nan)
    found = net.prepare(replace(batch, depth=damaged))
    assert found.level1.depth.isfinite().all()
    assert torch.equal(found.level1.depth, expected.level1.depth)
    # The true validity stands beside filled depth.
    assert torch.equal(found.level1.depth[:, :, 1:] > 0, batch.valid)
    holes = found.level1.depth[:, 2:, :1][~batch.valid[:, 2:]]
    assert bool(holes.any()) is (fill == "push-pull")


def test_filling_leaves_the_context_and_the_validity_alone():
    batch = micro.batch(2)
    assert fill_holes(batch, PAPER) is batch
    found = fill_holes(batch, HintConfig(fill="push-pull"))
    known = batch.valid.expand_as(batch.images)
    assert torch.equal(found.images[known], batch.images[known])
    assert torch.equal(found.valid, batch.valid)
    assert found.images[~known].any() and (found.depth[:, 2:] > 0).all()
    assert ((found.images >= 0) & (found.images <= 1)).all()


def test_statistics_there_and_back():
    statistics = LatentStatistics(5)
    generator = torch.Generator().manual_seed(0)
    statistics.mean.copy_(torch.randn(5, generator=generator) * 10)
    statistics.var.copy_(torch.rand(5, generator=generator) * 100)
    statistics.var[2] = 0
    raw = torch.randn(4, 5, 6, 2, generator=generator, dtype=torch.float64)
    latent = statistics.normalise(raw)
    assert latent.dtype == torch.float64
    # The variance is a float32; that of a dead channel is held up by eps.
    deviation = (statistics.var + 1e-5).sqrt().double()
    expected = (raw.movedim(1, -1) - statistics.mean.double()) / deviation
    torch.testing.assert_close(latent, expected.movedim(-1, 1))
    torch.testing.assert_close(statistics.denormalise(latent), raw)


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


LAYERS = micro.LAYERS


@torch.no_grad()
def test_depth_reaches_every_view_through_its_embedder_alone():
    net = micro.denoiser()
    x, t, known = micro.conditions()
    assert known.depth is not None
    other = known.depth.clone()
    other[:, -1, 0, :8, :8] += 1  # the first token of the last view
    found, changed = net(x, t, known), net(x, t, replace(known, depth=other))
    assert ((found - changed).abs().amax((2, 3, 4)) > 1e-6).all()
    (s, head), (s2, head2) = (net.embed(x, replace(known, depth=d)) for d in (known.depth, other))
    token = torch.zeros(s.shape[:3], dtype=torch.bool)
    token[:, -1, 0] = True
    assert torch.equal((s != s2).any(-1), token)
    assert torch.equal(head, head2)
    # Without the condition it is as a depth of zero everywhere but for the embedder's bias.
    net.depth_embedder.proj.bias.zero_()
    assert torch.equal(
        net(x, t, replace(known, depth=None)),
        net(x, t, replace(known, depth=torch.zeros_like(known.depth))),
    )


@torch.no_grad()
def test_context_views_come_first_and_have_their_own_embedders():
    net = micro.denoiser()
    x, _, known = micro.conditions(context=2, targets=3)
    before = net.embed(x, known)
    for name in ("s_embedder_ref", "x_embedder_ref"):
        getattr(net, name).proj.bias += 1
    for old, new in zip(before, net.embed(x, known), strict=True):
        change = (new - old).abs().amax((0, 2, 3))
        assert (change[:2] > 0.5).all() and not change[2:].any()


@torch.no_grad()
def test_one_time_a_sample_is_the_same_time_for_its_views():
    net = micro.denoiser().double()
    x, t, known = micro.conditions(dtype=torch.float64)
    views = x.shape[1]
    expected = net(x, t, known)
    found = net(x, t[:, None].expand(-1, views), known)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    later = t[:, None].repeat(1, views)
    later[:, -1] = 0.1
    assert (net(x, later, known) - expected).abs().max() > 1e-3


def permuted(known: Conditions, order: list[int]) -> Conditions:
    assert known.depth is not None
    camera = replace(
        known.camera,
        map=known.camera.map[:, order],
        cam_from_world=known.camera.cam_from_world[:, order],
        K=known.camera.K[:, order],
    )
    return replace(
        known, latents=known.latents[:, order], camera=camera, depth=known.depth[:, order]
    )


@pytest.mark.parametrize("order", [[0, 1, 4, 2, 3], [1, 0, 2, 3, 4]])
@torch.no_grad()
def test_permuted_views_give_permuted_results(order):
    net = micro.denoiser().double()
    x, t, known = micro.conditions(dtype=torch.float64)
    expected = net(x, t, known)[:, order]
    found = net(x[:, order], t, permuted(known, order))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    # Views differ, and a target is no context view.
    assert (net(x, t, known) - expected).abs().max() > 0.1
    swapped = [2, 1, 0, 3, 4]
    there = net(x[:, swapped], t, permuted(known, swapped))
    assert (there - net(x, t, known)[:, swapped]).abs().max() > 0.01


@pytest.mark.parametrize("invert_K", [True, False])
@torch.no_grad()
def test_attention_does_not_see_the_world_frame(invert_K):
    net = micro.denoiser(replace(micro.DENOISER, invert_K=invert_K)).double()
    x, t, known = micro.conditions(dtype=torch.float64)
    world = torch.eye(4).double()
    world[:3, :3] = torch.from_numpy(micro.rotation((1, 2, -1), 0.8))
    world[:3, 3] = torch.tensor([0.5, -2.0, 1.0])
    expected = net(x, t, known)

    def seen_from(poses: Tensor) -> Tensor:
        return net(x, t, replace(known, camera=replace(known.camera, cam_from_world=poses)))

    found = seen_from(known.camera.cam_from_world @ world)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)
    # Moving all cameras changes nothing, bringing them together does.
    assert (seen_from(world.expand(2, 5, 4, 4)) - expected).abs().max() > 0.01


@torch.no_grad()
def test_streams_stay_in_full_precision_under_autocast():
    net = micro.denoiser()
    x, t, known = micro.conditions()
    seen: list[tuple[torch.dtype, torch.dtype]] = []
    for module in net.modules():
        if isinstance(module, DenoiserBlock):
            module.register_forward_hook(lambda m, a, out: seen.append((a[0].dtype, out.dtype)))
    expected = net(x, t, known)
    seen.clear()
    with torch.autocast("cpu", torch.bfloat16):
        found = net(x, t, known)
    assert seen == [(torch.float32, torch.float32)] * len(net.blocks)
    error = (found.float() - expected).norm() / expected.norm()
    assert 1e-6 < error < 0.03


def test_only_the_encoder_is_conditioned_on_the_source():
    cascade = micro.denoiser(micro.config().cascade)
    x, _, known = micro.conditions()
    source = torch.randn_like(x)
    given = replace(known, source=source, depth=None)
    (s, head), (s2, head2) = (
        cascade.embed(x, given),
        cascade.embed(x, replace(given, source=source + 1)),
    )
    assert torch.equal(head, head2) and not torch.equal(s, s2)
