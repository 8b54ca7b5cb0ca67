from __future__ import annotations

from dataclasses import replace

import geoverse_models as micro
import pytest
import torch
from torch import Tensor

from gvtools.completers.geoverse.denoiser import Conditions, DenoiserBlock

pytestmark = pytest.mark.usefixtures("one_thread")

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
