"""Everything that is measured on a finished run: pictures, consistency, poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gvtools.runs.memory_file import load_memory
from pipelines.evaluation.means import mean
from pipelines.evaluation.measured_target import context_pictures, run_targets, true_pictures
from pipelines.evaluation.measurement import PARTS, Measurement

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.features import FeatureMatcher
    from gvtools.runs.run import Run
    from pipelines.console import Console

__all__ = ["PARTS", "evaluate_run"]


def evaluate_run(
    run: Run,
    *,
    parts: Sequence[str],
    lpips: Lpips | None,
    no_lpips: str | None,
    matcher: FeatureMatcher | None = None,
    control: bool = True,
    seed: int = 0,
    console: Console,
) -> dict[str, Any]:
    """Measure one run.

    The figures are JSON-ready, by part; what could not be measured is None, with the reason under
    ``notes``.

    Args:
        run: with at least one round of targets.
        parts: of PARTS.
        lpips: the network, or None.
        no_lpips: why there is none.
        matcher: of the pose probe; None is SIFT.
        control: measure the true pictures of the targets as well, to read the figures by.
        seed: of resampling, matching and robust estimates.
        console: for progress.
    """
    targets = run_targets(run)
    measurement = Measurement(
        parts=parts,
        context=lambda: context_pictures(run, load_memory(run.path, up_to=0)),
        truths=true_pictures(targets),
        lpips=lpips,
        no_lpips=no_lpips,
        matcher=matcher,
        control=control,
        seed=seed,
        console=console,
    )
    return {
        "rounds": len(run.rounds) - 1,
        "views": len(targets),
        "coverage": mean([target.coverage for target in targets]),
        "seconds_per_view": _seconds_per_view(run),
        **measurement.of(targets),
    }


def _seconds_per_view(run: Run) -> float | None:
    reports = run.rounds[1:]
    views = sum(len(report["views"]) for report in reports)
    return sum(report["seconds"]["total"] for report in reports) / views if views else None
