"""Finished runs measured, ranked beside published rows, and written as JSON and tables."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError
from gvtools.evaluation.images import FIGURES
from gvtools.evaluation.published import (
    Benchmark,
    Setting,
    benchmark_names,
    common,
    comparison_table,
    load_benchmark,
    protocol_split,
    side_by_side,
)
from gvtools.evaluation.statistics import LEVEL, RESAMPLES, mean_interval, mean_known
from gvtools.files import write_json
from gvtools.runs.digests import versions
from gvtools.runs.layout import METRICS, RECORD
from gvtools.runs.run import Run, load_memory
from gvtools.untrusted import read_json
from pipelines.console import Console
from pipelines.report import nested
from pipelines.scoring.measurement import (
    Measurement,
    MeasureOptions,
    context_pictures,
    load_measured,
    matcher_called,
    run_targets,
    true_pictures,
)
from pipelines.scoring.tables import (
    measured_row,
    print_table,
    summary_table,
    view_table,
    write_tables,
)

if TYPE_CHECKING:
    from gvtools.features import FeatureMatcher
    from gvtools.scenes.scene import Scene

# A target's photograph has changed where its PSNR has by more than this [dB].
CHANGED = 0.5
# Context and target views of a round, and rounds.
PROTOCOLS = {"pass": (2, 6, 1), "long": (2, 6, 3)}


def load_benchmarks(shown: Sequence[str], data_set: str | None) -> dict[str, Benchmark]:
    """Published benchmarks by name: those with the paper's protocol, and those to be shown."""
    if data_set is not None:
        load_benchmark(data_set)
    known = {name: load_benchmark(name) for name in benchmark_names()}
    papers = {name: b for name, b in known.items() if b.splits[0].kind == "protocol"}
    return papers | {name: load_benchmark(name) for name in shown}


def load_runs(paths: Sequence[Path], *, project: Path | None) -> list[Run]:
    """Runs with at least one completed target each."""
    if len({path.resolve() for path in paths}) < len(paths):
        raise OptionError("a run is given twice; expected each once")
    return [load_measured(path, project=project) for path in paths]


def run_protocol(
    scene: Scene,
    out: Path,
    *,
    protocol: str,
    stride: int | None,
    seed: int,
    completer: str | None,
    profile: str | None,
    changes: Sequence[str],
    reading: Mapping[str, Any],
    console: Console,
) -> Path:
    """Split the views by one of PROTOCOLS, run, and write the split beside the run; its folder."""
    from gvtools.settings import with_texts, with_values
    from pipelines.reconstruction.run import reconstruct
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.report import draw_run

    context, targets, rounds = PROTOCOLS[protocol]
    split = protocol_split(
        scene.names, context=context, targets=targets, rounds=rounds, stride=stride, seed=seed
    )
    start = RunSettings() if profile is None else with_values(RunSettings(), {"profile": profile})
    decided = {
        "context": ",".join(split.context),
        "targets": ",".join(split.targets),
        "views_per_round": targets,
        "rounds": rounds,
        "seed": seed,
        "completer": completer or start.completer,
    }
    for key in (text.partition("=")[0].strip() for text in changes):
        if key in decided:
            raise OptionError(f"--set {key}: decided by --protocol; leave it out")
    config = with_texts(with_values(start, decided), changes)
    folder = out / "run"
    resume = (folder / RECORD).is_file()
    done = reconstruct(
        scene, config, folder, console=console, resume=resume, reading=reading, draw=draw_run
    )
    write_json(out / "split.json", {"protocol": protocol, **split.to_dict()})
    return done


def evaluate_run(
    run: Run,
    options: MeasureOptions,
    *,
    matcher: FeatureMatcher | None = None,
    console: Console,
) -> dict[str, Any]:
    """Measure one run with at least one round of targets, and say what was measured."""
    record, targets = run.record, run_targets(run)
    measurement = Measurement(
        options=options,
        context=lambda: context_pictures(run, load_memory(run.path, up_to=0)),
        truths=true_pictures(targets),
        console=console,
        matcher=matcher,
    )
    reports = run.rounds[1:]
    seconds = sum(report["seconds"]["total"] for report in reports)
    views = sum(len(report["views"]) for report in reports)
    schedule = [[record["targets"][row] for row in rows] for rows in record["schedule"]]
    return {
        "name": run.path.resolve().name,
        "run": str(run.path),
        "project": record["project"],
        "split": {"context": record["context"], "rounds": schedule},
        "seed": record["settings"]["seed"],
        "settings": record["settings"],
        "derived": record["derived"],
        "versions": record["versions"],
        "seconds_of_rounds": seconds,
        "rounds": len(reports),
        "views": len(targets),
        "coverage": mean_known([target.coverage for target in targets]),
        "seconds_per_view": seconds / views if views else None,
        **measurement.of(targets),
    }


def evaluate_runs(
    runs: Sequence[Run], options: MeasureOptions, *, console: Console
) -> list[dict[str, Any]]:
    """The figures of each run, with what they were measured on."""
    matcher = matcher_called(options.matcher)

    def measure(run: Run) -> dict[str, Any]:
        console.line(f"{run.path}: {len(run.rounds) - 1} rounds")
        if not run.complete:
            console.warn(f"{run.path}: not every round is done; measured are those that are")
        evaluation = evaluate_run(run, options, matcher=matcher, console=console)
        _check_photographs(run, evaluation, console=console)
        return evaluation

    evaluations = [measure(run) for run in runs]
    # Runs of one name are told apart by the folders that they lie in.
    names = [evaluation["name"] for evaluation in evaluations]
    for evaluation in evaluations:
        if names.count(evaluation["name"]) > 1:
            folder = Path(evaluation["run"]).resolve()
            evaluation["name"] = f"{folder.parent.name}/{folder.name}"
    return evaluations


def _check_photographs(run: Run, evaluation: Mapping[str, Any], *, console: Console) -> None:
    """Warn of targets whose PSNR was another when the run ended: their photographs have changed."""
    # A run that is not done has no figures, and damaged ones are said where they are shown.
    with suppress(OSError, ValueError, TypeError, KeyError):
        own = {view["name"]: view["psnr"] for view in read_json(run.path / METRICS)["views"]}
        now = {view["name"]: view["psnr"] for view in evaluation["images"]["views"]}
        changed = [n for n in now if n in own and now[n] and abs(now[n] - own[n]) > CHANGED]
        if changed:
            first = changed[0]
            console.warn(
                f"{run.path}: {len(changed)} of {len(now)} target photographs are not those that "
                f"the run was measured on (first {first}: {own[first]:.1f} dB then, "
                f"{now[first]:.1f} now); give the project as it was (--project)"
            )


def write_evaluation(
    runs: Sequence[Run],
    evaluations: Sequence[dict[str, Any]],
    options: MeasureOptions,
    *,
    name: str,
    data_set: str | None,
    benchmarks: dict[str, Benchmark],
    shown: Sequence[str],
    out: Path,
    console: Console,
) -> dict[str, Any]:
    """Write evaluation.json and the tables, print the summary, and return the figures.

    The measured row has the name; only runs of a data set are ranked. The tables of all benchmarks
    are written, those shown are printed as well.
    """
    setting = _setting(options, runs, evaluations, data_set=data_set)
    row = measured_row(name, evaluations, setting)
    comparisons = {}
    for key, benchmark in benchmarks.items():
        # Of several numbers of context views, that of the runs, if there are rows of it.
        alike = benchmark.at(
            setting.context if setting.context in benchmark.views else benchmark.context
        )
        comparisons[key] = comparison_table(side_by_side([row], alike), alike)
    figures = _over_runs(evaluations, row.figures, options)
    over = figures["over_scenes"] if len(evaluations) > 1 else {}
    tables = {"summary": summary_table(evaluations, "Evaluation", over)}
    for number, evaluation in enumerate(evaluations):
        if "images" in evaluation:
            views = evaluation["images"]["views"]
            key = "views" if len(evaluations) == 1 else f"views_{number:03d}"
            tables[key] = view_table(views, evaluation["name"])
    tables |= {f"published_{key}": table for key, table in comparisons.items()}
    write_json(out / "evaluation.json", figures)
    write_tables(out, tables)
    for table in (tables["summary"], *(comparisons[key] for key in shown)):
        if table.caption:
            console.line(table.caption)
        print_table(table, console, ranks=True)
    console.line(f"results in {out}: evaluation.json, and tables as .csv, .md and .tex")
    return figures


def _setting(
    options: MeasureOptions,
    runs: Sequence[Run],
    evaluations: Sequence[Mapping[str, Any]],
    *,
    data_set: str | None,
) -> Setting:
    """How the figures were measured, as far as it decides what they may be ranked with."""
    reports = [report for run in runs for report in run.rounds[1:]]
    cameras = [view["camera"] for report in reports for view in report["views"]]
    met3r = [nested(e, "consistency.generated.met3r.status") for e in evaluations]
    poses = [e["poses"] for e in evaluations if nested(e, "poses.pictures")]
    located = sum(part["located"] for part in poses), sum(part["pictures"] for part in poses)
    masked = max(
        (e["images"]["settings"]["masked_share"] for e in evaluations if "images" in e), default=0
    )
    return Setting(
        data_set=data_set,
        resolution=common((camera["width"], camera["height"]) for camera in cameras),
        context=common(len(run.record["context"]) for run in runs),
        targets=common(len(report["views"]) for report in reports),
        rounds=common(len(run.rounds) - 1 for run in runs),
        scenes=len({run.record["project"] for run in runs}),
        pixels="inside masks" if masked > 0 else "all",
        lpips_net=options.lpips_net if options.lpips else None,
        poses_from=f"pose probe ({options.matcher}), {located[0]} of {located[1]} views located",
        pose_unit="scene units",
        reprojection=None,
        met3r="original" if set(met3r) == {"measured"} else None,
        hardware=f"{os.cpu_count()} CPU cores",
    )


def _over_runs(
    evaluations: Sequence[Mapping[str, Any]],
    row: Mapping[str, float | None],
    options: MeasureOptions,
) -> dict[str, Any]:
    """What evaluation.json holds: figures over all runs at the top, then each run's."""
    over = {}
    for name in FIGURES:
        means = [nested(e, f"images.mean.{name}.mean") for e in evaluations]
        over[name] = mean_interval(means, seed=options.seed)
    poses = [e["poses"] for e in evaluations if nested(e, "poses.pictures")]
    notes: dict[str, str] = {}
    for evaluation in evaluations:
        notes |= nested(evaluation, "images.notes") or {}
    return {
        **{name: interval.mean for name, interval in over.items()},
        "coverage": mean_known([e["coverage"] for e in evaluations]),
        "views": sum(e["views"] for e in evaluations),
        "seconds_per_view": mean_known([e["seconds_per_view"] for e in evaluations]),
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
            **provenance(),
        },
        "runs": list(evaluations),
        "notes": notes,
    }


def provenance() -> dict[str, Any]:
    """By what figures were made, and when."""
    return {
        "bootstrap": {"level": LEVEL, "resamples": RESAMPLES},
        "versions": versions(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }
