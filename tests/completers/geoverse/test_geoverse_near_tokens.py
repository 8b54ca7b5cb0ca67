"""Steps that look at tokens near holes alone."""

from __future__ import annotations

from typing import Any

import geoverse_models as micro
import pytest
import torch
from torch import Tensor

from gvtools.completers.geoverse import model as model_module
from gvtools.completers.geoverse.active_tokens import MOST, NearTokens, near_tokens
from gvtools.completers.geoverse.denoiser import Denoiser
from gvtools.completers.geoverse.model import GeoVerse

pytestmark = pytest.mark.usefixtures("one_thread")

BOUNDS = (1.0, 0.7, 0.3, 0.0)
TOKENS = micro.GRID[0] * micro.GRID[1]


@pytest.fixture(scope="module")
def core() -> GeoVerse:
    built: GeoVerse = micro.model(micro.config())
    return built


def sampled(core: GeoVerse, near: NearTokens | None) -> Tensor:
    batch = micro.batch(1, context=2, targets=2)
    prepared = core.prepare(batch)
    noise = torch.randn(prepared.hints.level1.shape, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        return core.sample1(prepared, noise, bounds=BOUNDS, near=near)


def test_where_all_tokens_are_near_nothing_changes(core):
    whole = sampled(core, None)
    again = sampled(core, NearTokens(torch.arange(4 * TOKENS)))
    torch.testing.assert_close(again, whole, rtol=1e-4, atol=1e-4)


def test_the_others_stay_as_the_first_step_left_them(core):
    active = torch.tensor([2 * TOKENS + 5, 2 * TOKENS + 6, 3 * TOKENS])
    near = NearTokens(active)
    made = sampled(core, near).flatten(3).transpose(2, 3).flatten(1, 2)
    whole = sampled(core, None).flatten(3).transpose(2, 3).flatten(1, 2)
    batch = micro.batch(1, context=2, targets=2)
    prepared = core.prepare(batch)
    noise = torch.randn(prepared.hints.level1.shape, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        one = core.sample1(prepared, noise, bounds=BOUNDS[:1] + BOUNDS[-1:])
    one = one.flatten(3).transpose(2, 3).flatten(1, 2)
    others = torch.ones(4 * TOKENS, dtype=torch.bool)
    others[active] = False
    # A straight path: its first direction, all the way.
    torch.testing.assert_close(made[:, others], one[:, others], rtol=1e-4, atol=1e-4)
    assert (made[:, active] - one[:, active]).abs().max() > 1e-3
    nearer = (made - whole)[:, active].norm() / (one - whole)[:, active].norm()
    assert nearer < 1


def test_later_steps_compute_the_active_tokens_alone(core, monkeypatch):
    seen: list[int] = []
    block = type(core.level1.blocks[0])
    forward = block.forward

    def counted(self: Any, x: Tensor, *args: Any) -> Tensor:
        seen.append(x.shape[1] * x.shape[2])
        return forward(self, x, *args)

    monkeypatch.setattr(block, "forward", counted)
    sampled(core, NearTokens(torch.tensor([2 * TOKENS, 2 * TOKENS + 1])))
    blocks = len(core.level1.blocks)
    assert seen == [4 * TOKENS] * blocks + [2] * 2 * blocks


def test_tokens_near_a_hole_are_its_own_and_those_around():
    valid = torch.ones(1, 3, 1, 24, 32, dtype=torch.bool)
    assert near_tokens(valid, 1, (3, 4)) is None
    valid[0, 2, 0, 5, 30] = False
    # Photographs are never completed.
    valid[0, 0, 0, 0, 0] = False
    found = near_tokens(valid, 1, (3, 4))
    assert found is not None
    at = {(int(i) // 12, int(i) % 12 // 4, int(i) % 4) for i in found.active}
    assert at == {(2, 0, 2), (2, 0, 3), (2, 1, 2), (2, 1, 3)}
    everywhere = torch.zeros_like(valid)
    assert near_tokens(everywhere, 0, (3, 4)) is None and MOST > 2 / 3
    assert near_tokens(valid.expand(2, -1, -1, -1, -1), 1, (3, 4)) is None


@pytest.mark.parametrize(
    ("bounds", "cfg_scale", "injection", "used"),
    [(BOUNDS, 1.0, "none", True), (BOUNDS[::3], 1.0, "none", False), (BOUNDS, 2.0, "none", False),
     (BOUNDS, 1.0, "control", False)],
)  # fmt: skip
def test_passes_that_need_whole_steps_make_them(bounds, cfg_scale, injection, used, monkeypatch):
    built: GeoVerse = micro.model(micro.config(injection=injection))
    given: list[Any] = []
    forward = Denoiser.forward

    def looked(self: Denoiser, *args: Any, **options: Any) -> Tensor:
        if self is built.level1:
            given.append(options.get("near"))
        return forward(self, *args, **options)

    monkeypatch.setattr(Denoiser, "forward", looked)
    monkeypatch.setattr(model_module, "near_tokens", few)
    batch = micro.batch(1, context=2, targets=2)
    video = None if injection == "none" else micro.video_features(1, 4)
    built.generate(batch, bounds=bounds, cfg_scale=cfg_scale, video=video, near_holes=True)
    assert {near is not None for near in given} == {used}


def few(valid: Tensor, context: int, grid: tuple[int, int]) -> NearTokens:
    return NearTokens(torch.tensor([2 * TOKENS]))
