"""``gvtools bench complete --predict``: what a pass takes on named cards, by stage.

The library's own code runs on tensors without numbers, as in ``memory``. Of every kernel the
operations are counted, and the bytes that it reads and writes. It takes as long as the slower of
the two, at the rates that the card's maker states times their shares in ``REACHED``, which were set
by the passes that were measured on an H200 (``benchmarks/complete.md``), not compiled.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry, sdpa_backward_flop_count, sdpa_flop_count

from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import DECODING
from gvtools.networks.compute import autocast
from pipelines.bench.complete import BETWEEN, CPU_ATTENTION, INSIDE, PASS, random_views
from pipelines.bench.memory import (
    CPU,
    alone,
    fake_tensors,
    model_without_numbers,
    pass_of,
    run_without_numbers,
)
from pipelines.bench.options import CompleteOptions

if TYPE_CHECKING:
    from pipelines.console import Console


class Card(NamedTuple):
    """As its maker states it, without sparsity."""

    name: str
    bandwidth: float  # of its memory, TB/s
    half: float  # TFLOP/s of products in 16 bits, summed in float32
    tf32: float  # of convolutions of float32, which cuDNN rounds
    float32: float


CARDS = (
    Card("H200", 4.8, 989, 494, 67),
    Card("H100", 3.35, 989, 494, 67),
    Card("A100 80 GB", 2.04, 312, 156, 19.5),
    Card("L40S", 0.864, 362, 183, 91.6),
    Card("RTX 4090", 1.008, 165, 82.6, 82.6),
    Card("RTX 3090", 0.936, 71, 35.6, 35.6),
)
# Shares of the stated rates, see the module.
REACHED = {"product": 0.8, "attention": 0.4, "convolution": 0.2, "bytes": 1.0}
# Scores of attention take as long as those of heads of so many channels, their exponentials being
# as many.
HEAD = 128
# A kernel takes no less on a device, and its host no less to ask for it, s.
LEAST, ASKED = 4e-6, 28e-6
# The CPU's, by what torch counts of a GPU's: with how many tensors its arguments begin.
_ATTENTION: dict[Any, tuple[Any, int]] = {
    CPU_ATTENTION: (sdpa_flop_count, 3),
    getattr(torch.ops.aten, f"{CPU_ATTENTION.__name__}_backward"): (sdpa_backward_flop_count, 4),
}


class Kernel(NamedTuple):
    """What is asked of a device at once."""

    work: str  # of ``REACHED``
    kind: str  # of its numbers, the card's field
    flops: int
    bytes: int
    heads: int = HEAD  # channels of a head

    def seconds(self, card: Card) -> float:
        """On a card."""
        rate = getattr(card, self.kind) * 1e12 * REACHED[self.work]
        flops = self.flops * max(1, HEAD / self.heads)
        return max(flops / rate, self.bytes / (card.bandwidth * 1e12 * REACHED["bytes"]), LEAST)


class Work(TorchDispatchMode):
    """Counts the kernels that run within it, by the stage that a model calls ``clock`` with."""

    def __init__(self) -> None:
        super().__init__()
        self.stages: dict[str, Counter[Kernel]] = {}
        self.stage = BETWEEN

    @contextmanager
    def clock(self, stage: str) -> Iterator[None]:
        """Count towards a stage."""
        before, self.stage = self.stage, f"{INSIDE}{stage}" if stage in DECODING else stage
        yield
        self.stage = before

    def __torch_dispatch__(  # noqa: PLR0917
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Run an operation and count it."""
        kwargs = kwargs or {}
        out = run_without_numbers(func, *args, **kwargs)
        kernel = _kernel(func, (args, kwargs), out)
        if kernel is not None:
            self.stages.setdefault(self.stage, Counter())[kernel] += 1
        return out


def _kernel(func: Any, inputs: tuple[Any, Any], out: Any) -> Kernel | None:
    """None for what computes nothing: views, empty tensors, questions."""
    given, made = (
        [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)] for tree in (inputs, out)
    )
    before, after = ({t.untyped_storage()._cdata for t in tensors} for tensors in (given, made))
    packet = func._overloadpacket
    if not (after - before or func._schema.is_mutable) or "empty" in packet.__name__:
        return None
    work, flops, heads = "product", 0, HEAD
    if packet in _ATTENTION:
        count, operands = _ATTENTION[packet]
        work, flops = "attention", count(*(tensor.shape for tensor in inputs[0][:operands]))
        heads = inputs[0][0].shape[-1]
    elif packet in flop_registry:
        work = "convolution" if "convolution" in packet.__name__ else "product"
        flops = flop_registry[packet](*inputs[0], **inputs[1], out_val=out)
    whole = "tf32" if work == "convolution" else "float32"
    kind = "half" if (made or given)[0].element_size() == 2 else whole
    return Kernel(work, kind, int(flops), sum(map(_bytes, (*given, *made))), heads)


def _bytes(tensor: Tensor) -> int:
    """What is read of a tensor once; what is repeated to fit others is not."""
    sides = zip(tensor.shape, tensor.stride(), strict=True)
    return tensor.element_size() * math.prod(size for size, stride in sides if stride)


def prediction_figures(options: CompleteOptions) -> dict[str, Any]:
    """The figures as a JSON object, a row for each stage under ``results``."""
    config = options.network()
    if options.video is False:
        config = replace(config, video=None, injection="none")
    stages = alone(_pass, options, config)
    stages[PASS] = sum(stages.values(), Counter())
    return {
        "bench": "prediction",
        **options.conditions(config),
        "results": [row_of(stage, work) for stage, work in stages.items()],
    }


def row_of(stage: str, work: Counter[Kernel]) -> dict[str, Any]:
    """What its kernels do and take."""
    return {
        "name": stage,
        "flops": sum(kernel.flops * count for kernel, count in work.items()),
        "bytes": sum(kernel.bytes * count for kernel, count in work.items()),
        "kernels": work.total(),
        "seconds": {
            card.name: max(
                sum(kernel.seconds(card) * count for kernel, count in work.items()),
                work.total() * ASKED,
            )
            for card in CARDS
        },
    }


def _pass(options: CompleteOptions, config: GeoVerseConfig) -> dict[str, Counter[Kernel]]:
    """By stage, in their order."""
    with fake_tensors():
        model = model_without_numbers(config)
        model.hold_in(options.compute_type)
        size = options.picture(config)
        batch = random_views(size, context=options.context, targets=options.targets)
        with Work() as work, autocast(CPU, options.compute_type):
            model.clock = work.clock
            model.generate(batch, **options.sampling(config))
    return work.stages


def show_prediction(figures: dict[str, Any], console: Console) -> None:
    """One table, in ms."""
    console.line(f"{pass_of(figures)}, not compiled: predicted ms")
    console.table(
        ("stage", "TFLOP", "GB", "kernels", *(card.name for card in CARDS)),
        [
            (row["name"], row["flops"] / 1e12, row["bytes"] / 1e9, row["kernels"],
             *(1e3 * seconds for seconds in row["seconds"].values()))
            for row in figures["results"]
        ],
    )  # fmt: skip
