"""The sweep: make every trial, and choose among them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gvtools.errors import GvError
from pipelines.console import Console
from pipelines.tradeoff.trial import Trial, Trials

# Trials that differ by less are equally accurate, dB.
EQUAL = 0.02


def sweep(
    planned: Mapping[str, Mapping[str, Any]],
    runs: Trials,
    *,
    limit: float,
    console: Console,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Trial]:
    """Make the trials in their order; those of earlier sweeps take no time.

    Args:
        planned: settings of each trial by its label, the start first.
        runs: makes trials.
        limit: seconds for all but the start; trials that would not fit are left out and named.
        console: is told of each trial.
        clock: seconds.
    """
    end = clock() + limit
    trials: list[Trial] = []
    left_out = []
    for label, settings in planned.items():
        trial = runs.kept(label, settings)
        # A trial is expected to take as long as the start and its tuning, or the time of its fit.
        fit = settings.get("refine.seconds") or 0.0
        tuning = 60 * settings.get("tune.minutes", 0.0)
        expected = max(trials[0].seconds + tuning, fit) if trials else 0.0
        if trial is None and trials and clock() + expected > end:
            left_out.append(label)
            continue
        try:
            trial = trial or runs.make(label, settings)
        except GvError as error:
            if not trials:
                raise
            console.line(f"{label}: refused, {error}")
            continue
        trials.append(trial)
        console.line(f"{label}: {described(trial)}")
    if left_out:
        console.warn(
            f"{len(left_out)} trials were left out for --limit: {', '.join(left_out[:4])}; "
            "the same command with a longer one goes on"
        )
    return trials


def described(trial: Trial) -> str:
    """Its accuracy and its costs."""
    return f"{trial.psnr:.2f} dB, {trial.seconds:.1f} s, {trial.bytes / 2**20:.0f} MiB"


def pareto_front(trials: Sequence[Trial]) -> list[Trial]:
    """Trials that no other beats in both time and PSNR, fastest first."""
    front: list[Trial] = []
    for trial in sorted(trials, key=lambda trial: (trial.seconds, -trial.psnr)):
        if not front or trial.psnr > front[-1].psnr:
            front.append(trial)
    return front


def recommended(trials: Sequence[Trial], budget: float | None) -> Trial | None:
    """The most accurate trial within the budget, of equal ones the fastest; None if none fits.

    Args:
        trials: to choose from.
        budget: seconds of a run; None for no limit.
    """
    within = [trial for trial in trials if budget is None or trial.seconds <= budget]
    highest = max((trial.psnr for trial in within), default=0.0)
    best = [trial for trial in within if trial.psnr >= highest - EQUAL]
    return min(best, key=lambda trial: trial.seconds, default=None)
