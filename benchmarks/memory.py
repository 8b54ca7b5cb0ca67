"""The predicted peak memory of a model beside what it takes on this CPU: counted, and resident.

    python benchmarks/memory.py [--config tiny] [--size 96] [--case pass]

Counted is the same count with numbers in the tensors. Resident is by how much the process grew, as
Linux sees it: what torch's own kernels take, and what the allocator keeps, is in it. Each row is a
process of its own.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from gvtools.completers.geoverse.config import named
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.training.options import OptimizerOptions
from gvtools.training.samples import TrainingBatch
from pipelines.bench.complete import random_views
from pipelines.bench.memory import alone, fake_tensors, pass_peaks, step_peaks

CASES = ("pass", "denoiser", "denoiser, recompute")
MB = 1e6


def peak(case: str, config: str, size: int) -> int:
    """Bytes beside the weights at the peak of a pass of 2 + 6 views or of a training step."""
    model = GeoVerse(named(config)).eval()
    batch = random_views((size, size), context=2, targets=6)
    if case == "pass":
        return max(pass_peaks(model, batch, dtype=torch.float32).values())
    truth = TrainingBatch(batch, torch.rand_like(batch.images), 1 + batch.depth)
    options = OptimizerOptions(batch=1, recompute="recompute" in case)
    rows = step_peaks(model, truth, options)
    return max(rows.values())


def predicted_peak(case: str, config: str, size: int) -> int:
    """The same, without numbers."""
    with fake_tensors():
        return peak(case, config, size)


def resident(key: str) -> int:
    """VmRSS or VmHWM of this process, bytes."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(key)).split()[1])


def measured(case: str, config: str, size: int) -> tuple[int, int]:
    """Counted bytes, and by how many the process grew."""
    torch.set_num_threads(1)
    # Libraries are loaded and kernels chosen before.
    peak("pass", "tiny", 48)
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
    before = resident("VmRSS")
    counted = peak(case, config, size)
    return counted, resident("VmHWM") - before


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="tiny", choices=("tiny", "base"))
    parser.add_argument("--size", type=int, default=96, help="of the pictures, px (%(default)s)")
    parser.add_argument("--case", choices=CASES, help="this alone")
    args: Any = parser.parse_args()
    weights = sum(t.numel() * 4 for t in GeoVerse(named(args.config)).parameters())
    print("MB beside weights   predicted   counted   resident")
    for case in CASES if args.case is None else (args.case,):
        told = (case, args.config, args.size)
        before = alone(predicted_peak, *told)
        counted, grown = alone(measured, *told)
        # The process makes its weights, too.
        print(f"{case:20}{before / MB:8.1f}{counted / MB:10.1f}{(grown - weights) / MB:11.1f}")


if __name__ == "__main__":
    main()
