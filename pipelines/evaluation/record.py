"""What an evaluation is of: the runs' splits and settings, and the JSON that holds it all."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gvtools.evaluation.ranking import Setting
    from gvtools.runs.finished import FinishedRun


def described(finished: FinishedRun, figures: dict[str, Any]) -> dict[str, Any]:
    """The figures with what they were measured on."""
    record = finished.record
    schedule = [[record["targets"][row] for row in rows] for rows in record["schedule"]]
    reports = finished.reports[1:]
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
    args: argparse.Namespace,
    runs: Sequence[FinishedRun],
    evaluations: Sequence[Mapping[str, Any]],
    lpips: bool,
) -> Setting:
    """How the figures were measured, as far as it decides what they may be ranked with."""
    from gvtools.evaluation.ranking import Setting

    sizes = {
        (entry["camera"]["width"], entry["camera"]["height"])
        for finished in runs
        for report in finished.reports[1:]
        for entry in report["views"]
    }
    per_round = [len(report["views"]) for finished in runs for report in finished.reports[1:]]
    met3r = [e.get("consistency", {}).get("generated", {}).get("met3r") for e in evaluations]
    poses = [e["poses"] for e in evaluations if e.get("poses", {}).get("pictures")]
    located = sum(part["located"] for part in poses), sum(part["pictures"] for part in poses)
    masked = max(
        (e["images"]["settings"]["masked_share"] for e in evaluations if "images" in e), default=0
    )
    return Setting(
        data_set=args.data_set,
        # Mixed sizes and numbers are none of the published ones.
        resolution=sizes.pop() if len(sizes) == 1 else None,
        context=_common([len(finished.record["context"]) for finished in runs]),
        targets=_common(per_round),
        rounds=_common([len(finished.reports) - 1 for finished in runs]),
        scenes=len({finished.record["project"] for finished in runs}),
        pixels="inside masks" if masked > 0 else "all",
        lpips_net=args.lpips_net if lpips else None,
        poses_from=f"pose probe ({args.matcher}), {located[0]} of {located[1]} views located",
        pose_unit="scene units",
        reprojection=None,
        met3r="original" if all(m and m["status"] == "measured" for m in met3r) else None,
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
    args: argparse.Namespace,
    parts: Sequence[str],
) -> dict[str, Any]:
    """One JSON object: figures over all runs at the top, then each run's."""
    import time
    from dataclasses import asdict

    from gvtools.evaluation.intervals import LEVEL, RESAMPLES, mean_interval
    from gvtools.evaluation.view_figures import FIGURES
    from gvtools.runs.folder import versions

    means = {
        name: [e.get("images", {}).get("mean", {}).get(name, {}).get("mean") for e in evaluations]
        for name in FIGURES
    }
    over = {name: mean_interval(values, seed=args.seed) for name, values in means.items()}
    poses = [e["poses"] for e in evaluations if e.get("poses", {}).get("pictures")]
    notes = {key: text for e in evaluations for key, text in e.get("images", {})
             .get("notes", {}).items()}  # fmt: skip
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
            "seed": args.seed,
            "parts": list(parts),
            "matcher": args.matcher,
            "features": args.features or "dense-gradient",
            "lpips_net": args.lpips_net,
            "control": not args.no_control,
            "bootstrap": {"level": LEVEL, "resamples": RESAMPLES},
            "versions": versions(),
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
        },
        "runs": list(evaluations),
        "notes": notes,
    }
