"""What an evaluation is of: the runs' splits and settings, and the JSON that holds it all."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.report.nested import nested

if TYPE_CHECKING:
    from gvtools.evaluation.ranking import Setting
    from gvtools.runs.run import Run


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """What is measured, and how.

    Attributes:
        name: of the measured row.
        parts: of run_evaluation.PARTS.
        matcher: of the pose probe, "sift" or "lightglue".
        control: measure the true pictures of the targets as well.
        seed: of resampling, matching and robust estimates.
        data_set: that the runs are scenes of; None ranks nothing.
        lpips_net: backbone of LPIPS.
        lpips_measured: whether its weights are there.
    """

    name: str
    parts: tuple[str, ...]
    matcher: str
    control: bool
    seed: int
    data_set: str | None
    lpips_net: str
    lpips_measured: bool


def described(finished: Run, figures: dict[str, Any]) -> dict[str, Any]:
    """The figures with what they were measured on."""
    record = finished.record
    schedule = [[record["targets"][row] for row in rows] for rows in record["schedule"]]
    reports = finished.rounds[1:]
    passes = [report["seconds"]["total"] for report in reports]
    return {
        "name": finished.path.resolve().name,
        "run": str(finished.path),
        "project": record["project"],
        "split": {"context": record["context"], "rounds": schedule},
        "seed": record["settings"]["seed"],
        "settings": record["settings"],
        "derived": record["derived"],
        "versions": record["versions"],
        "seconds_of_rounds": sum(passes),
        **figures,
    }


def setting_of(
    options: EvaluationOptions, runs: Sequence[Run], evaluations: Sequence[Mapping[str, Any]]
) -> Setting:
    """How the figures were measured, as far as it decides what they may be ranked with."""
    from gvtools.evaluation.ranking import Setting

    sizes = {
        (entry["camera"]["width"], entry["camera"]["height"])
        for finished in runs
        for report in finished.rounds[1:]
        for entry in report["views"]
    }
    per_round = [len(report["views"]) for finished in runs for report in finished.rounds[1:]]
    met3r = [nested(e, "consistency", "generated", "met3r", "status") for e in evaluations]
    poses = [e["poses"] for e in evaluations if nested(e, "poses", "pictures")]
    located = sum(part["located"] for part in poses), sum(part["pictures"] for part in poses)
    masked = max(
        (e["images"]["settings"]["masked_share"] for e in evaluations if "images" in e), default=0
    )
    return Setting(
        data_set=options.data_set,
        # Mixed sizes and numbers are none of the published ones.
        resolution=sizes.pop() if len(sizes) == 1 else None,
        context=_common([len(finished.record["context"]) for finished in runs]),
        targets=_common(per_round),
        rounds=_common([len(finished.rounds) - 1 for finished in runs]),
        scenes=len({finished.record["project"] for finished in runs}),
        pixels="inside masks" if masked > 0 else "all",
        lpips_net=options.lpips_net if options.lpips_measured else None,
        poses_from=f"pose probe ({options.matcher}), {located[0]} of {located[1]} views located",
        pose_unit="scene units",
        reprojection=None,
        met3r="original" if set(met3r) == {"measured"} else None,
        hardware=f"{os.cpu_count()} CPU cores",
    )


def name_apart(evaluations: Sequence[dict[str, Any]]) -> None:
    """Give runs of one name the names of their folders as well."""
    names = [evaluation["name"] for evaluation in evaluations]
    for evaluation in evaluations:
        if names.count(evaluation["name"]) > 1:
            folder = Path(evaluation["run"]).resolve()
            evaluation["name"] = f"{folder.parent.name}/{folder.name}"


def _common(numbers: Sequence[int]) -> int | None:
    return numbers[0] if len(set(numbers)) == 1 else None


def joined(
    evaluations: Sequence[Mapping[str, Any]],
    row: Mapping[str, float | None],
    options: EvaluationOptions,
) -> dict[str, Any]:
    """One JSON object: figures over all runs at the top, then each run's."""
    import time
    from dataclasses import asdict

    from gvtools.evaluation.intervals import LEVEL, RESAMPLES, mean_interval
    from gvtools.evaluation.view_figures import FIGURES
    from gvtools.runs.identity import versions

    over = {}
    for name in FIGURES:
        means = [nested(e, "images", "mean", name, "mean") for e in evaluations]
        over[name] = mean_interval(means, seed=options.seed)
    poses = [e["poses"] for e in evaluations if nested(e, "poses", "pictures")]
    notes: dict[str, str] = {}
    for evaluation in evaluations:
        notes |= nested(evaluation, "images", "notes") or {}
    return {
        **{name: interval.mean for name, interval in over.items()},
        "coverage": mean_interval([e["coverage"] for e in evaluations]).mean,
        "views": sum(e["views"] for e in evaluations),
        "seconds_per_view": mean_interval([e["seconds_per_view"] for e in evaluations]).mean,
        "scenes": len(evaluations),
        "over_scenes": {name: asdict(interval) for name, interval in over.items()},
        "protocol_row": {
            **row,
            "located": sum(part["located"] for part in poses) if poses else None,
            "probed": sum(part["pictures"] for part in poses) if poses else None,
        },
        "evaluation": {
            "seed": options.seed,
            "parts": list(options.parts),
            "matcher": options.matcher,
            "lpips_net": options.lpips_net,
            "control": options.control,
            "bootstrap": {"level": LEVEL, "resamples": RESAMPLES},
            "versions": versions(),
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
        },
        "runs": list(evaluations),
        "notes": notes,
    }
