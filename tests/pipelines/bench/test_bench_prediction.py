from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import geoverse_models as micro
import pytest
import torch
import torch.nn.functional as F

from pipelines.bench.complete import INSIDE, TimedPass
from pipelines.bench.prediction import ASKED, CARDS, LEAST, Card, Counter, Kernel, Work, row_of
from pipelines.bench.random_model import random_views

pytestmark = pytest.mark.usefixtures("one_thread")

REPOSITORY = Path(__file__).resolve().parents[3]


def only(work: Work) -> Kernel:
    ((kernel, count),) = work.stages["between stages"].items()
    assert count == 1
    return kernel


def test_a_product_reads_and_writes_every_number_once():
    a, b = torch.rand(3, 4), torch.rand(4, 5)
    with Work() as work:
        a @ b
    assert only(work) == Kernel("product", "float32", 2 * 3 * 4 * 5, 4 * (12 + 20 + 15))
    with Work() as work:
        a.bfloat16()
    assert only(work) == Kernel("product", "half", 0, 4 * 12 + 2 * 12)
    with Work() as work:
        a.add_(b[:1, :1].expand(3, 4))
    assert only(work) == Kernel("product", "float32", 0, 4 * (12 + 1 + 12))
    with Work() as work:
        a.view(2, 6)[1:].t()
        torch.empty(100)
    assert not work.stages


def test_convolutions_and_attention_have_rates_of_their_own():
    x, kernels = torch.rand(1, 3, 8, 8), torch.rand(5, 3, 3, 3)
    with Work() as work:
        F.conv2d(x, kernels)
    kernel = only(work)
    assert (kernel.work, kernel.kind) == ("convolution", "tf32")
    assert kernel.flops == 2 * 5 * 36 * 27
    q = torch.rand(1, 2, 16, 8, requires_grad=True)
    with Work() as work:
        F.scaled_dot_product_attention(q, q, q).sum().backward()
    forward, backward = (
        kernel for kernel in work.stages["between stages"] if kernel.work == "attention"
    )
    # Two products of (16, 8, 16) for each of two heads; five in the backward pass.
    assert forward.flops == 2 * 2 * 2 * 16 * 16 * 8 and backward.flops == 2.5 * forward.flops
    assert forward.heads == backward.heads == 8


def test_a_kernel_takes_as_long_as_the_slower_of_its_two():
    card = Card("C", bandwidth=1, half=100, tf32=50, float32=10)
    assert Kernel("product", "half", 8 * 10**11, 10).seconds(card) == pytest.approx(0.01)
    assert Kernel("product", "half", 10, 2 * 10**12).seconds(card) == pytest.approx(2)
    assert Kernel("attention", "float32", 4 * 10**12, 0, 64).seconds(card) == pytest.approx(2)
    small = Kernel("product", "half", 1, 1)
    assert small.seconds(card) == LEAST
    seconds = row_of("S", Counter({small: 1000}))["seconds"]
    assert seconds == {one.name: pytest.approx(1000 * ASKED) for one in CARDS}


def test_the_operations_of_a_pass_are_those_that_torch_counts():
    model = micro.model()
    views = random_views((32, 32), context=1, targets=2)
    bounds = (1.0, 0.5, 0.0)
    counted = TimedPass(model, views, bounds=bounds, cascade_bounds=(1.0, 0.0)).flops()
    with Work() as work:
        model.clock = work.clock
        model.generate(views, bounds=bounds, cascade_bounds=(1.0, 0.0))
    found = {stage: row_of(stage, kernels)["flops"] for stage, kernels in work.stages.items()}
    assert found["level-1 step"] == counted["level-1 step 1"] + counted["level-1 step 2"]
    assert found["cascade step"] == counted["cascade step 1"]
    inside = [name for name in counted if name.startswith(INSIDE)]
    assert len(inside) == 3
    for name in ("hint encoding", *inside):
        assert found[name] == counted[name] > 0, name


@pytest.mark.slow
def test_the_table_and_the_figures(tmp_path):
    weights = micro.weights_folder(tmp_path / "weights")
    command = [sys.executable, "-m", "pipelines.cli", "bench", "complete", "--predict"]
    command += ["--weights", str(weights), "--size", "32", "--steps", "2"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert "micro, 2 + 6 views of 32x32, 2 + 1 steps, bfloat16, not compiled" in done.stdout
    assert "RTX 3090" in done.stdout
    file = tmp_path / "prediction.json"
    subprocess.run([*command, "--json", str(file)], cwd=REPOSITORY, check=True)
    figures = json.loads(file.read_text())
    *stages, whole = figures["results"]
    assert whole["name"] == "pass"
    for name in ("flops", "bytes", "kernels"):
        assert whole[name] == sum(row[name] for row in stages) > 0
    assert set(whole["seconds"]) == {card.name for card in CARDS}
