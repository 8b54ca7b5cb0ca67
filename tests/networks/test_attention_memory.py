"""No tensor of heads x N x M: counted over everything that torch creates, both ways."""

from __future__ import annotations

import importlib.util
from typing import Any

import geoverse_models as micro
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gvtools.completers.geoverse.denoiser import Denoiser, Positions
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.rgb_head import RGBHead
from gvtools.completers.geoverse.video_injection import ControlBranch, ControlConfig, video_keys
from gvtools.networks import compute
from gvtools.networks.compute import attend
from gvtools.networks.depth_anything.network import DepthAnything3

pytestmark = pytest.mark.usefixtures("one_thread")

GRID = (24, 32)  # 768 tokens a view
VIEWS = 4
TOKENS = VIEWS * GRID[0] * GRID[1]
SIZE = (GRID[0] * micro.PATCH, GRID[1] * micro.PATCH)


class Largest(TorchDispatchMode):
    """The most numbers in a tensor that was created."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        sizes = [leaf.numel() for leaf in tree_leaves(out) if isinstance(leaf, torch.Tensor)]
        self.count = max(self.count, *sizes, 0)
        return out


def conditions() -> Any:
    batch = micro.batch(targets=VIEWS - 2, size=SIZE)
    model = GeoVerse(micro.config(injection="shared")).eval()
    with torch.no_grad():
        return model, model.prepare(batch, video=micro.video_features(1, VIEWS, grid=GRID))


def test_a_matrix_of_scores_would_be_seen():
    q = torch.randn(1, 2, 512, 16)
    with Largest() as largest:
        (q @ q.mT).softmax(-1) @ q
    assert largest.count == 2 * 512 * 512
    with Largest() as largest, torch.nn.attention.sdpa_kernel(torch.nn.attention.SDPBackend.MATH):
        attend(q, q, q)
    assert largest.count == 2 * 512 * 512


@pytest.mark.slow
def test_the_denoiser_with_video_keys_and_with_the_control_branch():
    model, prepared = conditions()
    state = torch.randn(1, VIEWS, micro.CHANNELS, *GRID)
    t = torch.tensor([0.5])
    scores = micro.DENOISER.heads * TOKENS * TOKENS
    branch = ControlBranch(
        ControlConfig(micro.LAYERS), model.level1, video_channels=micro.VIDEO.channels
    )
    features = micro.video_features(1, VIEWS, grid=GRID)
    positions = Positions(micro.DENOISER, prepared.level1.camera, GRID)
    micro.awake(model.level1)
    for recompute in (False, True):
        model.level1.recompute = branch.recompute = recompute
        with Largest() as largest:
            keys = video_keys(
                model.shared,
                micro.DENOISER,
                prepared.level1.camera,
                features=features,
                grid=GRID,
            )
            adapted = branch.adapted(features.tensors, GRID)
            residuals = branch(
                model.level1, state, t, prepared.level1, adapted=adapted, positions=positions
            )
            out = model.level1(
                state, t, prepared.level1, residuals=residuals, video=keys, positions=positions
            )
            out.square().sum().backward()
        assert 0 < largest.count < scores / 4


def test_the_encoder_and_the_rgb_head():
    network = DepthAnything3(micro.CONFIG.geometry)
    images = torch.rand(1, VIEWS, 3, *SIZE)
    with Largest() as largest:
        levels = network.encode(images)
        levels[-1].sum().backward()
    assert 0 < largest.count < 2 * TOKENS * TOKENS / 4

    head = RGBHead(micro.CONFIG.rgb)
    grid = (64, 64)
    features = torch.randn(1, grid[0] * grid[1], micro.CONFIG.rgb.in_channels)
    with Largest() as largest:
        head(features, grid).sum().backward()
    assert 0 < largest.count < micro.CONFIG.rgb.heads * (grid[0] * grid[1]) ** 2 / 4


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("diffusers") is None, reason="needs diffusers")
def test_the_video_prior():
    import tiny_wan as tiny

    prior = tiny.prior()
    images = torch.rand(1, VIEWS, 3, 768, 768)
    tokens = VIEWS * 48 * 48
    with Largest() as largest:
        prior.features(images, torch.ones(1, VIEWS, 1, 768, 768), 2)
    assert 0 < largest.count < 2 * tokens * tokens / 4


# Where no fused kernel applies.


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_chunks_of_queries_give_the_same_within_their_bound(monkeypatch, dtype):
    generator = torch.Generator().manual_seed(0)

    def heads(count: int) -> torch.Tensor:
        made = torch.randn(2, 3, count, 8, generator=generator, dtype=torch.float64)
        return made.to(dtype).requires_grad_()

    q, k, v = heads(300), heads(200), heads(200)
    wanted = attend(q, k, v)
    gradients = torch.autograd.grad(wanted.square().sum(), (q, k, v))
    most = 2 * 3 * 200 * 17
    monkeypatch.setattr(compute, "MOST_SCORES", most)
    monkeypatch.setattr(compute, "_is_fused", lambda q: False)
    # As on such a card, only the kernel that builds the scores is there.
    kernel = torch.nn.attention.sdpa_kernel(torch.nn.attention.SDPBackend.MATH)
    with kernel, Largest() as largest:
        found = attend(q, k, v)
        again = torch.autograd.grad(found.square().sum(), (q, k, v))
    assert largest.count <= most
    near = 1e-10 if dtype == torch.float64 else 0.1
    torch.testing.assert_close(found, wanted, rtol=near, atol=near)
    torch.testing.assert_close(again, gradients, rtol=near, atol=near)


@pytest.mark.parametrize(
    ("capability", "dtype", "fused"),
    [
        ((7, 5), torch.float16, True),
        ((7, 5), torch.float32, True),
        ((7, 5), torch.bfloat16, False),
        ((8, 0), torch.bfloat16, True),
        ((9, 0), torch.float64, False),
    ],
)
def test_what_cards_have_fused_kernels_for(monkeypatch, capability, dtype, fused):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)

    class Query:
        device = torch.device("cuda")

    query: Any = Query()
    query.dtype = dtype
    assert compute._is_fused(query) is fused


def test_denoisers_are_what_the_networks_hold():
    # The list above is complete: no module attends in another way.
    names = {
        type(module).__name__
        for part in (GeoVerse(micro.config(injection="control")), Denoiser(micro.DENOISER))
        for module in part.modules()
    }
    assert not names & {"MultiheadAttention", "TransformerEncoderLayer"}
