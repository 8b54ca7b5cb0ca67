from __future__ import annotations

import copy

import geoverse_models as micro
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from posed_cuda import posed_cuda
from torch import nn

from gvtools.completers.geoverse.completer import GeoVerseCompleter
from pipelines.bench.random_model import random_views

SAME = "Expected all tensors to be on the same device"


@pytest.fixture
def posed():
    with posed_cuda() as operations:
        yield operations


def test_outside_torch_is_as_it_was():
    before = torch.cuda.is_available()
    with posed_cuda():
        assert torch.cuda.is_available() and torch.cuda.get_device_capability() == (8, 0)
        x = torch.ones(3, device="cuda")
    assert torch.cuda.is_available() == before
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert F.linear(torch.ones(1, 3), torch.ones(2, 3)).dtype == torch.bfloat16
    assert x.is_cuda


@pytest.mark.usefixtures("posed")
def test_what_is_made_on_it_or_moved_to_it_says_so():
    made = [
        torch.zeros(2, device="cuda"),
        torch.tensor([1.0, 2.0], device="cuda:0"),
        torch.arange(3).to("cuda"),
        torch.ones(2).cuda(),
        torch.ones(2).to(torch.zeros(1, device="cuda")),
        torch.ones(2, device="cuda").new_tensor([1.0]),
        torch.ones(2, device="cuda").new_zeros(3),
        torch.zeros_like(torch.ones(2), device="cuda"),
        torch.ones(2, 3, device="cuda").mT[0] * 2,
        torch.from_numpy(np.ones(2)).to("cuda", torch.float32),
    ]
    with torch.device("cuda"):
        made += [torch.ones(3), nn.Linear(2, 2).weight]
    for x in made:
        assert x.device == torch.device("cuda", 0) and x.is_cuda and not x.is_cpu
    x = made[0]
    assert x.to("cuda") is x and x.cuda() is x
    for back in (x.cpu(), x.to("cpu"), torch.zeros_like(x, device="cpu"), x.to(torch.ones(1))):
        assert back.device.type == "cpu" and not back.is_cuda and type(back) is torch.Tensor
    assert torch.ones(2, device="cpu").device.type == "cpu"
    assert x.to(torch.float64).is_cuda and x.to("cpu", torch.float64).dtype == torch.float64
    assert torch.empty(2, device="meta").device.type == "meta"


@pytest.mark.usefixtures("posed")
def test_two_devices_in_one_operation_are_refused():
    x, y = torch.ones(2, 3, device="cuda"), torch.ones(2, 3)
    for mixed in (
        lambda: x + y,
        lambda: y + x.sum(),
        lambda: x @ y.mT,
        lambda: torch.cat([x, y]),
        lambda: torch.stack([x.sum(), torch.tensor(1.0)]),
        lambda: torch.where(x > 0, x, y),
        lambda: torch.equal(x, y),
        lambda: x.gather(1, torch.zeros(2, 1, dtype=torch.long)),
        lambda: x[:, 0].index_add_(0, torch.tensor([0]), torch.ones(1)),
        lambda: x.__setitem__(torch.tensor([0]), y[:1]),
        lambda: F.linear(x, y),
    ):
        with pytest.raises(RuntimeError, match=SAME):
            mixed()
    with pytest.raises(RuntimeError, match="indices should be either on cpu"):
        y[torch.tensor([0], device="cuda")]
    with pytest.raises(TypeError, match="can't convert cuda:0"):
        x.numpy()
    with pytest.raises(TypeError, match="can't convert cuda:0"):
        np.asarray(x)
    with pytest.raises(RuntimeError, match="generator"):
        x.normal_(generator=torch.Generator())
    with pytest.raises(RuntimeError, match="generator"):
        torch.rand(2, device="cuda", generator=torch.Generator())


@pytest.mark.usefixtures("posed")
def test_what_torch_allows_across_devices_works():
    x, y = torch.ones(2, 3, device="cuda"), torch.arange(6.0).reshape(2, 3)
    scalar, index = torch.tensor(2.0), torch.tensor([1])
    for allowed in (x + scalar, scalar * x, torch.where(x > 0, scalar, x), x[index], x[y > 3]):
        assert allowed.is_cuda
    x.copy_(y)
    x[index] = torch.tensor(7.0)
    x[:1] = y[:1]
    y.copy_(x)
    assert y.tolist() == [[0, 1, 2], [7, 7, 7]] == x.tolist()
    assert float(x.sum()) == 24 and x.cpu().numpy().sum() == 24


def test_modules_move_with_their_parameters_and_train(posed):
    net = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4), nn.GELU(), nn.Linear(4, 1))
    first = net[0].weight
    optimizer = torch.optim.AdamW(net.parameters(), lr=0.1)
    twin = copy.deepcopy(net)
    net.to("cuda")
    assert net[0].weight is first and first.is_cuda and isinstance(first, nn.Parameter)
    x = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    net(x.to("cuda")).square().sum().backward()
    twin(x).square().sum().backward()
    assert first.grad is not None and first.grad.is_cuda
    torch.testing.assert_close(first.grad.cpu(), twin[0].weight.grad)
    optimizer.step()
    assert posed["aten::addmm"] == 2
    moved = copy.deepcopy(net)
    torch.testing.assert_close(net.to("cpu")(x), moved(x.to("cuda")).cpu())
    # Gradients cross devices.
    leaf = torch.ones(3, requires_grad=True)
    (leaf.to("cuda") * 2).cpu().sum().backward()
    assert leaf.grad is not None and leaf.grad.tolist() == [2, 2, 2]


@pytest.mark.usefixtures("posed")
def test_autocast_has_cudas_lists_and_leaves_the_cpus_alone():
    x, w = torch.ones(2, 4, device="cuda"), torch.ones(4, 4, device="cuda")
    half = x.bfloat16()
    q = torch.ones(1, 1, 2, 8, device="cuda")
    with torch.autocast("cuda", dtype=torch.bfloat16):
        for low in (x @ w, F.linear(x, w), F.scaled_dot_product_attention(q, q, q)):
            assert low.dtype == torch.bfloat16
        # In autocast for CPUs, some of these stay in half precision.
        for single in (
            F.layer_norm(half, (4,)),
            half.softmax(-1),
            half.exp(),
            half.sum(),
            x + half,
        ):
            assert single.dtype == torch.float32
        for kept in (half + half, F.gelu(half), (x.double() @ w.double()).half()):
            assert kept.dtype in (torch.bfloat16, torch.float16)
        assert (x.double() @ w.double()).dtype == torch.float64
        assert F.linear(x.cpu(), w.cpu()).dtype == torch.float32
        with torch.autocast("cuda", enabled=False):
            assert (x @ w).dtype == torch.float32
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert (x @ w).dtype == torch.float32


def test_a_batch_that_was_left_on_the_cpu_is_found(posed):
    model = micro.model().to("cuda")
    with pytest.raises(RuntimeError, match=SAME):
        model.generate(micro.batch(), seed=1)


def test_auto_is_the_posed_device(posed, tmp_path):
    completer = GeoVerseCompleter(weights=str(micro.weights_folder(tmp_path / "weights")))
    assert next(completer.model.parameters()).is_cuda


WAITS = ("nonzero", "unique", "_local_scalar_dense", "equal")


def test_a_pass_waits_for_the_device_only_to_learn_which_views_have_hints(posed, tmp_path):
    completer = GeoVerseCompleter(
        weights=str(micro.weights_folder(tmp_path)), device="cuda", precision="float32"
    )
    batch = random_views((24, 32), context=2, targets=2).to("cuda")
    model = completer.model
    posed.clear()
    model.generate(batch)
    waits = {name: n for name, n in posed.items() if any(word in name for word in WAITS)}
    assert 0 < sum(waits.values()) <= 3, waits
