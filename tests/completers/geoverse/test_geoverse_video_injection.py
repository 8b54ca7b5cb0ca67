from __future__ import annotations

from dataclasses import replace
from typing import Any

import geoverse_models as micro
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.completers.geoverse.camera_encoding import Projective
from gvtools.completers.geoverse.denoiser import Positions
from gvtools.completers.geoverse.video_injection import (
    ControlBranch,
    ControlConfig,
    SharedAttention,
    SharedAttentionConfig,
    VideoKeys,
)
from gvtools.errors import OptionError

LAYERS = micro.LAYERS


class Case:
    """A denoiser with non-zero gates, its control branch, and one step's input."""

    def __init__(self, *, layers: tuple[int, ...] = LAYERS, double: bool = False) -> None:
        dtype = torch.float64 if double else torch.float32
        self.net: Any = micro.denoiser().to(dtype)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            self.branch: Any = ControlBranch(
                ControlConfig(layers), self.net, video_channels=micro.VIDEO.channels
            ).to(dtype)
        self.x, self.t, self.known = micro.conditions(dtype=dtype)
        self.positions = Positions(self.net.config, self.known.camera, micro.GRID)
        features = micro.video_features(*self.x.shape[:2])
        self.features = [level.to(dtype) for level in features[: len(layers)]]

    def residuals(self) -> dict[int, Tensor]:
        adapted = self.branch.adapted(self.features, micro.GRID)
        return self.branch(
            self.net, self.x, self.t, self.known, adapted=adapted, positions=self.positions
        )

    def velocity(self, residuals: dict[int, Tensor] | None = None) -> Tensor:
        return self.net(self.x, self.t, self.known, residuals=residuals, positions=self.positions)


def gradients(case: Case) -> dict[str, set[bool]]:
    case.branch.zero_grad()
    case.velocity(case.residuals()).square().mean().backward()
    found: dict[str, set[bool]] = {}
    for name, parameter in case.branch.named_parameters():
        assert parameter.grad is not None
        found.setdefault(name.split(".")[0], set()).add(bool(parameter.grad.any()))
    return found


def test_the_outputs_learn_first_and_the_rest_of_the_branch_after_them():
    case = Case()
    assert gradients(case) == {"adapters": {False}, "blocks": {False}, "outputs": {True}}
    torch.optim.SGD(case.branch.parameters(), lr=0.1).step()
    assert gradients(case) == {"adapters": {True}, "blocks": {True}, "outputs": {True}}


def reference(case: Case) -> Tensor:
    """Eqs. 5 and 6, one block after the other."""
    net, branch = case.net, case.branch
    h, head = net.embed(case.x, case.known)
    stream = h
    time = net.time(case.t, case.x.shape[1])
    level = 0
    for index in range(net.config.depth):
        h = net.blocks[index](h, F.silu(time), case.positions.encoder)
        if index in branch.config.layers:
            feature = case.features[level]
            pixels = branch.adapters[level].reduce(feature.flatten(0, 1))
            pixels = F.interpolate(pixels, size=micro.GRID, mode="bilinear", align_corners=False)
            tokens = branch.adapters[level].mix(F.silu(pixels)).flatten(2).mT
            inner = stream + tokens.unflatten(0, case.x.shape[:2])
            stream = branch.blocks[level](inner, F.silu(time), case.positions.encoder)
            h = h + branch.outputs[level](stream)
            level += 1
    s = net.s_projector(F.silu(time + h))
    for block in net.blocks[net.config.depth :]:
        head = block(head, s, case.positions.head)
    return net.final_layer(head, s).mT.unflatten(3, micro.GRID)


@pytest.mark.parametrize("layers", [LAYERS, (2,), (0, 1, 2, 4)])
@torch.no_grad()
def test_residuals_enter_after_the_configured_blocks_and_no_others(layers):
    case = Case(layers=layers, double=True)
    micro.awake(case.branch)
    residuals = case.residuals()
    assert tuple(residuals) == layers
    expected = reference(case)
    torch.testing.assert_close(case.velocity(residuals), expected, rtol=1e-10, atol=1e-10)
    for layer in layers:
        rest = {index: value for index, value in residuals.items() if index != layer}
        assert (case.velocity(rest) - expected).abs().max() > 1e-4, layer


@pytest.mark.parametrize("layers", [(0, 1, 2, 5), (0, 1, 2), (3, 1, 2, 4), (1, 1, 2, 3)])
@pytest.mark.parametrize("injection", ["control", "shared"])
def test_layers_that_the_denoiser_does_not_have_are_refused(injection, layers):
    kind = replace(getattr(micro.CONFIG, injection), layers=layers)
    with pytest.raises(OptionError, match=rf"{injection}\.layers = .*expected 4 ascending"):
        micro.config(injection=injection, **{injection: kind})


HEADS = micro.DENOISER.heads
HEAD_DIM = micro.DENOISER.width // HEADS


class SharedCase:
    """A denoiser, the projections of video features, and one step's input, in float64."""

    def __init__(self, *, gated: bool = True, grid: tuple[int, int] = (2, 3)) -> None:
        self.net: Any = micro.denoiser().double()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(2)
            self.shared: Any = SharedAttention(
                SharedAttentionConfig(LAYERS, gated=gated),
                self.net.config,
                video_channels=micro.VIDEO.channels,
            ).double()
        self.x, self.t, self.known = micro.conditions(dtype=torch.float64)
        self.positions = Positions(self.net.config, self.known.camera, micro.GRID)
        features = micro.video_features(*self.x.shape[:2], grid=grid)
        self.features = tuple(level.double() for level in features)
        camera = self.known.camera
        self.video_positions = Projective(
            camera.cam_from_world, camera.K, camera.size, grid=grid, head_dim=HEAD_DIM,
            position_scale=(micro.GRID[0] / grid[0], micro.GRID[1] / grid[1]),
            invert_K=self.net.config.invert_K,
        )  # fmt: skip

    def keys(self) -> dict[int, VideoKeys]:
        return self.shared(self.features, self.known.camera, micro.GRID)

    def velocity(self, keys: dict[int, VideoKeys] | None) -> Tensor:
        return self.net(self.x, self.t, self.known, video=keys, positions=self.positions)


def plain_attention(case: SharedCase, layer: int, x: Tensor) -> Tensor:
    """One joint attention, token by token, as the appendix words it."""
    attention: Any = case.net.blocks[layer].attn
    index = LAYERS.index(layer)
    feature = case.features[index]
    normed = case.shared.norms[index](feature.permute(0, 1, 3, 4, 2).flatten(1, 3))
    both = case.shared.kv[index](normed)
    width = micro.DENOISER.width

    def heads(tokens: Tensor) -> Tensor:
        return tokens.unflatten(-1, (HEADS, HEAD_DIM)).transpose(1, 2)

    q, k, v = (heads(part) for part in attention.qkv(x).split(width, dim=-1))
    encoding = case.positions.encoder
    q, k, v = encoding.query(q), encoding.key(k), encoding.value(v)
    video_k, video_v = (heads(part) for part in both.split(width, dim=-1))
    video_k, video_v = case.video_positions.key(video_k), case.video_positions.value(video_v)
    scores = torch.cat((q @ k.mT, q @ video_k.mT), dim=-1) / HEAD_DIM**0.5
    weights = scores.exp() / scores.exp().sum(-1, keepdim=True)
    count = k.shape[2]
    out = weights[..., :count] @ v + weights[..., count:] @ video_v
    return attention.proj(encoding.output(out).transpose(1, 2).flatten(2))


@torch.no_grad()
def test_attention_is_joint_over_both_kinds_of_tokens():
    case = SharedCase(gated=False)
    keys = case.keys()
    assert tuple(keys) == LAYERS
    generator = torch.Generator().manual_seed(4)
    tokens = case.x.shape[1] * micro.GRID[0] * micro.GRID[1]
    x = torch.randn(2, tokens, micro.DENOISER.width, generator=generator).double()
    for layer in LAYERS:
        attention: Any = case.net.blocks[layer].attn
        found = attention(x, case.positions.encoder, keys[layer])
        torch.testing.assert_close(found, plain_attention(case, layer, x), rtol=1e-9, atol=1e-9)
        assert (found - attention(x, case.positions.encoder)).abs().max() > 0.01


@torch.no_grad()
def test_video_tokens_stand_where_the_geometric_ones_stand():
    """A second copy of every key and value changes no attention, if its position is the same."""
    case = SharedCase(gated=False, grid=micro.GRID)
    generator = torch.Generator().manual_seed(4)
    attention: Any = case.net.blocks[0].attn
    feature = torch.randn(2, 5, micro.VIDEO.channels, *micro.GRID, generator=generator).double()
    into = torch.randn(micro.DENOISER.width, micro.VIDEO.channels, generator=generator).double()
    normed = case.shared.norms[0](feature.permute(0, 1, 3, 4, 2).flatten(1, 3))
    x = normed @ into.T
    width = micro.DENOISER.width
    case.shared.kv[0].weight.copy_(attention.qkv.weight[width:] @ into)
    case.shared.kv[0].bias.copy_(attention.qkv.bias[width:])
    case.features = (feature, *case.features[1:])
    found = attention(x, case.positions.encoder, case.keys()[0])
    alone = attention(x, case.positions.encoder)
    torch.testing.assert_close(found, alone, rtol=1e-9, atol=1e-9)
    assert alone.std() > 0.05


@torch.no_grad()
def test_a_gate_of_zero_is_the_pretrained_block_and_of_one_the_papers():
    gated, ungated = SharedCase(gated=True), SharedCase(gated=False)
    assert not gated.shared.gates.any() and not hasattr(ungated.shared, "gates")
    ungated.shared.load_state_dict(
        {k: v for k, v in gated.shared.state_dict().items() if k != "gates"}
    )
    expected = ungated.velocity(ungated.keys())
    assert torch.equal(gated.velocity(gated.keys()), gated.velocity(None))
    gated.shared.gates.fill_(1)
    torch.testing.assert_close(gated.velocity(gated.keys()), expected, rtol=1e-9, atol=1e-9)
    gated.shared.gates.fill_(0.5)
    assert (gated.velocity(gated.keys()) - expected).abs().max() > 1e-3


@torch.no_grad()
def test_video_keys_are_computed_once(monkeypatch):
    model = micro.model(micro.config(injection="shared"))
    model.shared.gates.fill_(0.7)
    batch = micro.batch(1)
    features = micro.video_features(1, 4)
    calls: list[int] = []
    forward = SharedAttention.forward

    def counted(self: SharedAttention, *args: Any) -> dict[int, VideoKeys]:
        calls.append(1)
        return forward(self, *args)

    monkeypatch.setattr(SharedAttention, "forward", counted)
    bounds = (1.0, 0.6, 0.3, 0.1, 0.0)
    made = model.generate(batch, video=features, bounds=bounds)
    assert len(calls) == 1
    other = model.generate(batch, video=micro.video_features(1, 4, seed=1), bounds=bounds)
    assert (other.level1 - made.level1).abs().max() > 1e-3


@torch.no_grad()
def test_the_unconditional_branch_has_no_camera_in_the_video_keys_either():
    model = micro.model(micro.config(injection="shared"))
    model.shared.gates.fill_(1.0)
    batch = micro.batch(1)
    prepared = model.prepare(batch, video=micro.video_features(1, 4))
    turned = replace(batch, cam_from_world=batch.cam_from_world.flip(1))
    other = model.prepare(turned, video=micro.video_features(1, 4))
    # All that is left of the cameras is the unit of the depth condition.
    other = replace(other, level1=replace(other.level1, depth=prepared.level1.depth))
    state = torch.randn(prepared.hints.level1.shape, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([0.5])
    found = [model.velocity1(model.without_cameras(p), state, t) for p in (prepared, other)]
    assert torch.equal(*found)
    given = [model.velocity1(p, state, t) for p in (prepared, other)]
    assert (given[0] - given[1]).abs().max() > 1e-3
