from __future__ import annotations

import geoverse_models as micro
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from posed_cuda import posed_cuda

from gvtools.completers.geoverse.completer import GeoVerseCompleter
from pipelines.bench.complete import random_views

SAME = "Expected all tensors to be on the same device"


@pytest.fixture
def posed():
    with posed_cuda() as operations:
        yield operations


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
