from __future__ import annotations

import geoverse_models as micro
import numpy as np
import pytest
import torch

from gvtools.completers.geoverse.completer import GeoVerseCompleter
from gvtools.errors import OptionError
from gvtools.networks import compute
from gvtools.networks.compute import autocast, half_type, inference_type, training_type
from gvtools.training.options import OptimizerOptions

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


def test_the_probe_times_both_ways_and_leaves_nothing_changed():
    torch.manual_seed(3)
    before = torch.get_rng_state()
    with torch.no_grad():
        assert all(compute._least_seconds(dtype) > 0 for dtype in (torch.float32, *HALF[:1]))
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == 1


def test_training_in_float16_is_refused():
    with pytest.raises(OptionError, match="precision 'float16'; expected 'auto', 'float32' or 'b"):
        OptimizerOptions(precision="float16")


@pytest.mark.parametrize("dtype", HALF)
@pytest.mark.parametrize("injection", ["none", "control", "shared"])
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


@pytest.mark.parametrize("name", ["bfloat16", "float16"])
def test_a_completer_holds_its_weights_in_what_it_computes_in(tmp_path, name):
    folder = micro.weights_folder(tmp_path / "weights")
    context, known = micro.context_views(2), micro.guidance(1)
    full = GeoVerseCompleter(weights=str(folder))
    half = GeoVerseCompleter(weights=str(folder), precision=name)
    weight = "level1.blocks.0.attn.qkv.weight"
    assert half.model.get_parameter(weight).dtype == getattr(torch, name)
    assert full.model.get_parameter(weight).dtype == torch.float32
    error = np.abs(half.complete(context, known).rgb - full.complete(context, known).rgb)
    assert 0 < error.max() < 0.05
