"""Cost of training ``base`` on one, eight and sixty-four cards, by counted operations.

    python -m benchmarks.training_cost

A sample's forward and backward pass runs on tensors without numbers; ``pipelines.bench.prediction``
says what its kernels take. The optimiser's step, once a batch, and what cards tell each other are
not among it.
"""

from __future__ import annotations

from collections import Counter

import torch

from gvtools.completers.geoverse.config import named
from gvtools.networks.compute import autocast
from gvtools.training.options import shipped_or_read
from gvtools.training.samples import Draws, TrainingBatch
from gvtools.training.stages import DenoiserStage, ReflowStage
from pipelines.bench.complete import BETWEEN, random_views
from pipelines.bench.memory import CPU, alone, fake_tensors, model_without_numbers
from pipelines.bench.prediction import CARDS, Kernel, Work, row_of

KINDS = {"denoiser": DenoiserStage, "reflow": ReflowStage}
COUNTS = (1, 8, 64)
DAY = 86_400


def sample(stage: str) -> Counter[Kernel]:
    """The kernels of one sample of two context views and six targets."""
    config = named("base")
    with fake_tensors():
        model = model_without_numbers(config)
        views = random_views((config.image_size, config.image_size), context=2, targets=6)
        batch = TrainingBatch(views, torch.rand_like(views.images), 1 + views.depth)
        trained = KINDS[stage](model, getattr(shipped_or_read("base")[0], stage))
        with Work() as work:
            with autocast(CPU, torch.bfloat16):
                loss, _ = trained(batch, Draws(0, stage, 0, (0,)))
            loss.backward()
    return work.stages[BETWEEN]


def main() -> None:
    """Print the table."""
    settings = shipped_or_read("base")[0]
    for stage in KINDS:
        row = row_of(stage, alone(sample, stage))
        optimizer = getattr(settings, stage).optimizer
        samples = optimizer.steps * optimizer.batch
        print(f"{stage}: {samples:,} samples of {row['flops'] / 1e12:.0f} TFLOP")
        for card in CARDS:
            one = row["seconds"][card.name]
            days = " | ".join(f"{samples * one / count / DAY:.3g}" for count in COUNTS)
            print(f"| {card.name} | {one:.2f} | {days} |")


if __name__ == "__main__":
    main()
