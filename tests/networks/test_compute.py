from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import geoverse_models as micro
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gvtools.completers.geoverse.completer import GeoVerseCompleter
from gvtools.completers.geoverse.rgb_head import RGBHead
from gvtools.networks import compute
from gvtools.networks.compute import (
    Recomputing,
    attend,
    autocast,
    half_type,
    inference_type,
    set_recompute,
    training_type,
)
from gvtools.networks.depth_anything.network import DepthAnything3
from gvtools.training.options import DenoiserStageOptions, EncoderStageOptions, OptimizerOptions
from gvtools.training.samples import Draws, TrainingBatch
from gvtools.training.small_model_stages import EncoderStage
from gvtools.training.stages import DenoiserStage

pytestmark = pytest.mark.usefixtures("one_thread")
CPU, CUDA = torch.device("cpu"), torch.device("cuda")
HALF = [torch.bfloat16, torch.float16]


@pytest.mark.parametrize(
    ("capability", "infers", "trains"),
    [
        ((7, 5), torch.float16, torch.float32),
        ((8, 0), torch.bfloat16, torch.bfloat16),
        ((9, 0), torch.bfloat16, torch.bfloat16),
    ],
)
def test_a_card_computes_in_what_it_multiplies_itself(monkeypatch, capability, infers, trains):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    assert inference_type("auto", CUDA) == infers
    assert training_type("auto", CUDA) == trains
    assert half_type("bfloat16", CUDA) == infers
    assert half_type("float32", CUDA) == torch.float32
    # What the user names is what is used.
    assert inference_type("float32", CUDA) == torch.float32
    assert training_type("bfloat16", CUDA) == torch.bfloat16


def test_a_cpu_infers_in_float32_and_trains_in_what_is_faster(monkeypatch):
    assert inference_type("auto", CPU) == torch.float32
    assert half_type("bfloat16", CPU) == torch.bfloat16
    seconds = {torch.float32: 1.0, torch.bfloat16: 0.5}
    monkeypatch.setattr(compute, "_least_seconds", seconds.__getitem__)
    for share, wanted in ((0.5, torch.bfloat16), (0.95, torch.float32), (40.0, torch.float32)):
        seconds[torch.bfloat16] = share
        compute.bfloat16_is_faster.cache_clear()
        assert training_type("auto", CPU) == wanted
    compute.bfloat16_is_faster.cache_clear()


@pytest.mark.parametrize(
    ("injection", "dtype"),
    [("none", HALF[0]), ("control", HALF[0]), ("shared", HALF[0]), ("control", HALF[1])],
)
def test_weights_held_in_half_precision_give_the_same_bits(dtype, injection):
    model = micro.model(micro.config(injection=injection))
    batch = micro.batch()
    video = None if injection == "none" else micro.video_features(1, 4)
    with autocast(CPU, dtype):
        before = model.generate(batch, video=video)
    whole = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    model.hold_in(dtype)
    with autocast(CPU, dtype):
        after = model.generate(batch, video=video)
    assert torch.equal(before.level1, after.level1) and torch.equal(before.level0, after.level0)
    assert torch.equal(before.decoded.rgb, after.decoded.rgb)
    assert torch.equal(before.decoded.geometry.depth, after.decoded.geometry.depth)
    held = model.state_dict()
    exact = [name for name, tensor in held.items() if tensor.dtype == torch.float32]
    assert all(torch.equal(held[name], whole[name]) for name in exact)
    for name in (
        "statistics.0.mean",
        "statistics.1.var",
        "level1.t_embedder.W",
        "rgb_head.decoder_pos_embed",
        "geometry.backbone.pretrained.pos_embed",
        "geometry.backbone.pretrained.blocks.0.norm1.weight",
        "geometry.head.projects.0.weight",
    ):
        assert name in exact
    # What is large is rounded: everything but the geometry head, to a few per cent.
    outside = [name for name in held if not name.startswith("geometry.head.")]
    kept = sum(held[name].numel() for name in outside if name in exact)
    assert kept < 0.1 * sum(held[name].numel() for name in outside)


def test_a_completer_holds_its_weights_in_what_it_computes_in(tmp_path):
    folder = micro.weights_folder(tmp_path / "weights")
    views = micro.context_views(2), micro.guidance(1)
    weight = "level1.blocks.0.attn.qkv.weight"
    pictures = []
    for dtype in (torch.float32, *HALF):
        precision = str(dtype).removeprefix("torch.")
        completer = GeoVerseCompleter(weights=str(folder), precision=precision)
        assert completer.model.get_parameter(weight).dtype == dtype
        pictures.append(completer.complete(*views).rgb)
        assert len(pictures) == 1 or 0 < np.abs(pictures[-1] - pictures[0]).max() < 0.05


def batch() -> TrainingBatch:
    views = micro.batch(2)
    return TrainingBatch(views, torch.rand_like(views.images), 2 + torch.rand_like(views.depth))


def gradients(stage: Any, dtype: torch.dtype) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    draws = Draws(0, stage.name, 0, (0, 1))
    torch.manual_seed(0)
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        loss, _ = stage(batch(), draws)
    loss.backward()
    found = {name: p.grad for name, p in stage.named_parameters() if p.grad is not None}
    return loss.detach(), found


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(
    ("stage", "options", "parts"),
    [
        (DenoiserStage, DenoiserStageOptions, ("level1", "cascade", "control")),
        (EncoderStage, EncoderStageOptions, ("geometry.backbone", "geometry.head", "rgb_head")),
    ],
)
def test_the_same_loss_and_gradients_to_the_last_bit(stage, options, parts, dtype, monkeypatch):
    found = []
    ran: dict[str, int] = {}
    layer = Recomputing.layer

    def counted(self: Any, run: Any, *inputs: Any) -> Any:
        def running(*given: Any) -> Any:
            ran[type(self).__name__] = ran.get(type(self).__name__, 0) + 1
            return run(*given)

        return layer(self, running, *inputs)

    monkeypatch.setattr(Recomputing, "layer", counted)
    counts = []
    model = micro.model(micro.config(injection="control"))
    prior = SimpleNamespace(features=lambda *_, **__: micro.video_features(2, 4))
    model.attach_video(prior)  # type: ignore[arg-type]
    for recompute in (False, True):
        ran.clear()
        model.zero_grad(set_to_none=True)
        made = stage(model, options(optimizer=OptimizerOptions(recompute=recompute)))
        found.append(gradients(made, dtype))
        counts.append(dict(ran))
    (loss, plain), (again, recomputed) = found
    assert torch.equal(loss, again)
    assert plain.keys() == recomputed.keys() and len(plain) > 10
    for part in parts:
        assert any(name.startswith(f"model.{part}.") for name in plain)
    for name, gradient in plain.items():
        assert torch.equal(gradient, recomputed[name]), name
    # What carries a gradient ran twice.
    assert all(counts[1][name] > counts[0][name] for name in counts[0])


def test_nothing_runs_twice_without_gradients():
    model = micro.model()
    set_recompute(model, True)
    assert {type(m).__name__ for m in model.modules() if isinstance(m, Recomputing)} == {
        "Denoiser", "RGBHead", "DepthAnythingBackbone", "GeometryHead"
    }  # fmt: skip
    ran = []
    model.level1.blocks[0].register_forward_hook(lambda *_: ran.append(1))
    model.generate(micro.batch(), bounds=(1.0, 0.0))
    assert len(ran) == 1


VIEWS = 4


class Largest(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        sizes = [leaf.numel() for leaf in tree_leaves(out) if isinstance(leaf, torch.Tensor)]
        self.count = max(self.count, *sizes, 0)
        return out


def test_the_encoder_and_the_rgb_head():
    network = DepthAnything3(micro.CONFIG.geometry)
    images = torch.rand(1, VIEWS, 3, 12 * micro.PATCH, 16 * micro.PATCH)
    with Largest() as largest:
        levels = network.encode(images)
        levels[-1].sum().backward()
    assert 0 < largest.count < 2 * (VIEWS * 12 * 16) ** 2 / 4

    head = RGBHead(micro.CONFIG.rgb)
    grid = (32, 32)
    features = torch.randn(1, grid[0] * grid[1], micro.CONFIG.rgb.in_channels)
    with Largest() as largest:
        head(features, grid).sum().backward()
    assert 0 < largest.count < micro.CONFIG.rgb.heads * (grid[0] * grid[1]) ** 2 / 4


def heads(*shape: int, dtype=torch.float64, device="cpu") -> torch.Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(device, dtype)


# Where no fused kernel applies.


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_chunks_of_queries_give_the_same_within_their_bound(monkeypatch, dtype):
    q, k, v = (heads(2, 3, n, 8, dtype=dtype) for n in (300, 200, 201))
    q, k, v = (part.requires_grad_() for part in (q, k, v[:, :, :200]))
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


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def spelt_out(q, k, v):
    scores = (q.double() @ k.double().mT) / q.shape[-1] ** 0.5
    return scores.softmax(-1) @ v.double()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("size", [8, 20, 72])
def test_it_is_the_softmax_of_the_products(size, dtype, device):
    q = heads(2, 3, 37, size, dtype=dtype, device=device)
    k, v = (heads(2, 3, count, size, dtype=dtype, device=device)[:, :, :51] for count in (51, 60))
    out = attend(q, k, v)
    assert out.dtype == dtype and out.shape == q.shape
    tolerance = 1e-6 if dtype == torch.float32 else 2e-2
    torch.testing.assert_close(out.double(), spelt_out(q, k, v), rtol=tolerance, atol=tolerance)
