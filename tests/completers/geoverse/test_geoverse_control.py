from __future__ import annotations

from dataclasses import replace
from typing import Any

import geoverse_models as micro
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.completers.geoverse.denoiser import Conditions, Positions
from gvtools.completers.geoverse.video_injection import ControlBranch, ControlConfig
from gvtools.errors import OptionError

pytestmark = pytest.mark.usefixtures("one_thread")

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
        features = micro.video_features(*self.x.shape[:2]).to(dtype=dtype).tensors
        self.features = features[: len(layers)]

    def residuals(self) -> dict[int, Tensor]:
        adapted = self.branch.adapted(self.features, micro.GRID)
        return self.branch(
            self.net, self.x, self.t, self.known, adapted=adapted, positions=self.positions
        )

    def velocity(self, residuals: dict[int, Tensor] | None = None) -> Tensor:
        return self.net(self.x, self.t, self.known, residuals=residuals, positions=self.positions)


def gradients(case: Case) -> dict[str, set[bool]]:
    """Whether gradients are non-zero, by part of the branch."""
    case.branch.zero_grad()
    case.velocity(case.residuals()).square().mean().backward()
    found: dict[str, set[bool]] = {}
    for name, parameter in case.branch.named_parameters():
        assert parameter.grad is not None
        found.setdefault(name.split(".")[0], set()).add(bool(parameter.grad.any()))
    return found


def test_a_fresh_branch_leaves_the_denoiser_as_it_is():
    case = Case()
    residuals = case.residuals()
    assert set(residuals) == set(LAYERS)
    assert not any(residual.any() for residual in residuals.values())
    assert torch.equal(case.velocity(residuals), case.velocity())


def test_the_outputs_learn_first_and_the_rest_of_the_branch_after_them():
    case = Case()
    assert gradients(case) == {"adapters": {False}, "blocks": {False}, "outputs": {True}}
    torch.optim.SGD(case.branch.parameters(), lr=0.1).step()
    assert gradients(case) == {"adapters": {True}, "blocks": {True}, "outputs": {True}}


def test_the_denoiser_itself_learns_as_without_the_branch():
    case = Case()
    case.velocity(case.residuals()).square().mean().backward()
    found = {name: p.grad for name, p in case.net.named_parameters()}
    case.net.zero_grad(set_to_none=True)
    case.velocity().square().mean().backward()
    for name, parameter in case.net.named_parameters():
        if parameter.requires_grad:
            assert torch.equal(parameter.grad, found[name]), name


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


def test_blocks_are_copies_that_live_on_their_own():
    case = Case()
    for copy, layer in zip(case.branch.blocks, LAYERS, strict=True):
        for (name, own), other in zip(
            copy.named_parameters(), case.net.blocks[layer].parameters(), strict=True
        ):
            assert torch.equal(own, other), name
            assert own.data_ptr() != other.data_ptr()


@torch.no_grad()
def test_the_branch_sees_time_cameras_and_state_as_the_denoiser_does():
    case = Case()
    micro.awake(case.branch)
    before = case.residuals()

    def moved(**changes: Any) -> float:
        kept = case.x, case.t, case.known, case.positions
        for name, value in changes.items():
            setattr(case, name, value)
        found = case.residuals()
        case.x, case.t, case.known, case.positions = kept
        return max(float((found[layer] - before[layer]).abs().max()) for layer in LAYERS)

    known: Conditions = case.known
    turned = replace(known.camera, cam_from_world=known.camera.cam_from_world.flip(1))
    assert moved() == 0
    assert moved(x=case.x + 1) > 1e-3
    assert moved(t=case.t / 2) > 1e-3
    assert moved(known=replace(known, latents=known.latents + 1)) > 1e-3
    assert moved(positions=Positions(case.net.config, turned, micro.GRID)) > 1e-3


@torch.no_grad()
def test_features_of_the_grid_are_taken_as_they_are():
    case = Case()
    generator = torch.Generator().manual_seed(3)
    feature = torch.randn(1, 2, micro.VIDEO.channels, *micro.GRID, generator=generator)
    adapter = case.branch.adapters[0]
    expected = adapter.mix(F.silu(adapter.reduce(feature[0]))).flatten(2).mT
    assert torch.equal(adapter(feature, micro.GRID)[0], expected)
    half = adapter(feature.bfloat16(), micro.GRID)
    assert half.dtype == torch.float32 and (half - expected).abs().max() < 0.05


@pytest.mark.parametrize("layers", [(0, 1, 2, 5), (0, 1, 2), (3, 1, 2, 4), (1, 1, 2, 3)])
@pytest.mark.parametrize("injection", ["control", "shared"])
def test_layers_that_the_denoiser_does_not_have_are_refused(injection, layers):
    kind = replace(getattr(micro.CONFIG, injection), layers=layers)
    with pytest.raises(OptionError, match=rf"{injection}\.layers = .*expected 4 ascending"):
        micro.config(injection=injection, **{injection: kind})
