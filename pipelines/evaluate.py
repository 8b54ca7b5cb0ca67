"""``gvtools evaluate``: every measure on finished runs, or the protocol on a project."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError
from pipelines.lpips_arguments import add_lpips_arguments, open_lpips
from pipelines.scene_arguments import add_scene_arguments

if TYPE_CHECKING:
    from gvtools.evaluation.ranking import Setting
    from pipelines.console import Console
    from pipelines.finished_run import FinishedRun

SUMMARY = "measure finished runs: pictures, consistency, poses, beside published figures"
EXAMPLES = (
    "gvtools evaluate runs/kitchen --json kitchen.json",
    "gvtools evaluate scans/kitchen --protocol long --stride 3 --out runs/kitchen_long",
)
# Context and target views of a round, and rounds.
PROTOCOLS = {"pass": (2, 6, 1), "long": (2, 6, 3)}
MATCHERS = ("sift", "lightglue")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN",
        help="a run, several, or (--protocol) a project",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="default RUN/evaluation")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    parser.add_argument(
        "--parts",
        default="images,consistency,poses",
        metavar="NAMES",
        help="what to measure (default %(default)s)",
    )
    parser.add_argument(
        "--no-control",
        action="store_true",
        help="leave out the same measures on the true pictures, which tell how to read the figures",
    )
    parser.add_argument(
        "--matcher", choices=MATCHERS, default="sift", help="of the pose probe (default sift)"
    )
    parser.add_argument(
        "--against",
        action="append",
        default=[],
        metavar="BENCHMARK",
        help="print its published rows beside the measured one: dl3dv, realestate10k, mipnerf360, "
        "scannetv2 or all; the files hold all of them",
    )
    parser.add_argument(
        "--data-set",
        metavar="NAME",
        help="that the runs are scenes of; without it nothing is ranked",
    )
    parser.add_argument("--name", default="gvtools", help="of the measured row (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (0)")
    parser.add_argument(
        "--project", type=Path, metavar="DIR", help="where the run's project lies, if it was moved"
    )
    group = parser.add_argument_group("running the protocol on a project first")
    group.add_argument(
        "--protocol", choices=tuple(PROTOCOLS), help="pass: 2 context and 6 target views; long: "
        "three rounds of 6"
    )  # fmt: skip
    group.add_argument(
        "--stride", type=int, metavar="N", help="views from one to the next (default: widest)"
    )
    group.add_argument("--completer", metavar="NAME", help="default inpaint")
    group.add_argument("--profile", metavar="NAME", help="fast, balanced or accurate")
    group.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting")
    add_lpips_arguments(parser)
    add_scene_arguments(parser)


def run(args: argparse.Namespace, console: Console) -> None:
    """Measure, print, write.

    Raises:
        GvError: a run cannot be read, or an option is wrong.
    """
    from gvtools.evaluation.published import benchmark_names, load_benchmark
    from pipelines.console import write_json
    from pipelines.evaluation_tables import (
        comparison,
        measured_row,
        summary_table,
        view_table,
        write_tables,
    )
    from pipelines.finished_run import open_run
    from pipelines.run_evaluation import evaluate_run

    parts = _parts(args.parts)
    names = benchmark_names()
    shown = names if "all" in args.against else tuple(args.against)
    benchmarks = {name: load_benchmark(name) for name in dict.fromkeys((*names, *shown))}
    if args.data_set is not None:
        load_benchmark(args.data_set)
    if args.project is not None and len(args.runs) > 1:
        raise OptionError("--project: names the project of one run; give one run")
    out = _folder(args)
    lpips, no_lpips = open_lpips(args)
    if args.protocol is not None:
        args.runs = [_run_protocol(args, out, console)]
    runs = [open_run(path, project=args.project) for path in args.runs]
    evaluations = []
    for finished in runs:
        console.line(f"{finished.path}: {len(finished.reports) - 1} rounds")
        if not finished.whole:
            console.warn(f"{finished.path}: not every round is done; measured are those that are")
        found = evaluate_run(
            finished,
            parts=parts,
            lpips=lpips,
            no_lpips=no_lpips,
            matcher=_matcher(args.matcher),
            control=not args.no_control,
            seed=args.seed,
            console=console,
        )
        evaluations.append(_described(finished, found.figures))
    setting = _setting(args, runs, evaluations, lpips is not None)
    row = measured_row(args.name, evaluations, setting)
    comparisons = {name: comparison(row, benchmark) for name, benchmark in benchmarks.items()}
    tables = {"summary": summary_table(evaluations, "Evaluation")}
    for number, evaluation in enumerate(evaluations):
        if "images" in evaluation:
            views = evaluation["images"]["views"]
            key = "views" if len(evaluations) == 1 else f"views_{number:03d}"
            tables[key] = view_table(views, evaluation["name"])
    tables |= {f"published_{name}": table for name, table in comparisons.items()}
    figures = _joined(evaluations, row.figures, args.seed)
    write_json(out / "evaluation.json", figures)
    write_tables(out, tables)
    if args.json is not None:
        write_json(args.json, figures)
    for table in (tables["summary"], *(comparisons[name] for name in shown)):
        _print(table, console)
    console.line(f"results in {out}: evaluation.json, and tables as .csv, .md and .tex")


def _parts(text: str) -> tuple[str, ...]:
    from pipelines.run_evaluation import PARTS

    parts = tuple(part.strip() for part in text.split(",") if part.strip())
    unknown = [part for part in parts if part not in PARTS]
    if unknown or not parts:
        raise OptionError(f"--parts {text!r}; expected some of {', '.join(PARTS)}")
    return parts


def _folder(args: argparse.Namespace) -> Path:
    if args.protocol is not None:
        if args.out is None or len(args.runs) != 1:
            raise OptionError(
                "--protocol: needs one project, and --out for the run and its figures"
            )
        return Path(args.out)
    given = [name for name in ("stride", "completer", "profile") if getattr(args, name) is not None]
    if given or args.set:
        raise OptionError(f"--{(given or ['set'])[0]}: belongs to --protocol; leave it out")
    if args.out is not None:
        return Path(args.out)
    if len(args.runs) > 1:
        raise OptionError("several runs: expected --out for their common figures")
    return Path(args.runs[0]) / "evaluation"


def _matcher(name: str) -> Any:
    if name == "sift":
        return None
    from gvtools.evaluation.pose_probe.lightglue import LightGlueMatcher

    return LightGlueMatcher()


def _run_protocol(args: argparse.Namespace, out: Path, console: Console) -> Path:
    """Split the project, write the split beside the scores, and run it; the run's folder."""
    from gvtools.evaluation.protocol import protocol_split
    from pipelines import config as settings
    from pipelines.console import write_json
    from pipelines.reconstruct import reconstruct
    from pipelines.run_directory import RunDirectory
    from pipelines.scene_arguments import open_scene, reading_of

    context, targets, rounds = PROTOCOLS[args.protocol]
    scene = open_scene(args.runs[0], args)
    split = protocol_split(
        scene.names, context=context, targets=targets, rounds=rounds, stride=args.stride,
        seed=args.seed,
    )  # fmt: skip
    config = settings.RunConfig()
    if args.profile is not None:
        config = settings.with_profile(config, args.profile)
    chosen = {
        "context": ",".join(split.context),
        "targets": ",".join(split.targets),
        "views_per_round": targets,
        "rounds": rounds,
        "seed": args.seed,
        "completer": args.completer or config.completer,
    }
    for key, value in chosen.items():
        config = settings.with_setting(config, key, value)
    config = settings.with_settings(config, args.set)
    folder = out / "run"
    resume = (folder / "run.json").is_file()
    RunDirectory(folder).refuse_foreign()
    write_json(out / "split.json", {"protocol": args.protocol, **split.to_dict()})
    return reconstruct(
        scene, config, folder, console=console, resume=resume, reading=reading_of(args)
    )


def _described(finished: FinishedRun, figures: dict[str, Any]) -> dict[str, Any]:
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
        "seed": record["config"]["seed"],
        "config": record["config"],
        "versions": record["versions"],
        "seconds_per_pass": sum(passes) / len(passes),
        **figures,
    }


def _setting(
    args: argparse.Namespace,
    runs: Sequence[FinishedRun],
    evaluations: Sequence[Mapping[str, Any]],
    lpips: bool,
) -> Setting:
    from gvtools.evaluation.ranking import Setting

    sizes = {
        (entry["camera"]["width"], entry["camera"]["height"])
        for finished in runs
        for report in finished.reports[1:]
        for entry in report["views"]
    }
    per_round = {len(report["views"]) for finished in runs for report in finished.reports[1:]}
    met3r = [e.get("consistency", {}).get("generated", {}).get("met3r") for e in evaluations]
    return Setting(
        data_set=args.data_set,
        # Mixed sizes and numbers are none of the published ones.
        resolution=sizes.pop() if len(sizes) == 1 else (0, 0),
        context=_common([len(finished.record["context"]) for finished in runs]),
        targets=per_round.pop() if len(per_round) == 1 else 0,
        rounds=_common([len(finished.reports) - 1 for finished in runs]),
        scenes=len(runs),
        lpips_net=args.lpips_net if lpips else None,
        poses_from=f"pose probe ({args.matcher})",
        pose_unit="scene units",
        reprojection=None,
        met3r="original" if all(m and m["status"] == "measured" for m in met3r) else None,
        hardware=f"{os.cpu_count()} CPU cores",
    )


def _common(numbers: Sequence[int]) -> int:
    return numbers[0] if len(set(numbers)) == 1 else 0


def _joined(
    evaluations: Sequence[Mapping[str, Any]], row: Mapping[str, float | None], seed: int
) -> dict[str, Any]:
    """One JSON object: figures over all runs at the top, then each run's."""
    from dataclasses import asdict

    from gvtools.evaluation.intervals import mean_interval
    from gvtools.evaluation.view_figures import FIGURES

    means = {
        name: [e.get("images", {}).get("mean", {}).get(name, {}).get("mean") for e in evaluations]
        for name in FIGURES
    }
    over = {name: mean_interval(values, seed=seed) for name, values in means.items()}
    notes = {key: text for e in evaluations for key, text in e.get("images", {})
             .get("notes", {}).items()}  # fmt: skip
    return {
        **{name: interval.mean for name, interval in over.items()},
        "coverage": mean_interval([e["coverage"] for e in evaluations]).mean,
        "views": sum(e["views"] for e in evaluations),
        "seconds_per_view": mean_interval([e["seconds_per_view"] for e in evaluations]).mean,
        "scenes": len(evaluations),
        "over_scenes": {name: asdict(interval) for name, interval in over.items()},
        "protocol_row": dict(row),
        "runs": list(evaluations),
        "notes": notes,
    }


def _print(table: Any, console: Console) -> None:
    from gvtools.evaluation.tables import Cell

    if table.caption:
        console.line(table.caption)
    rows = [
        [value.value if isinstance(value, Cell) else value for value in row] for row in table.rows
    ]
    console.table([column.heading for column in table.columns], rows)
    for note in table.notes:
        console.line(f"  {note}")
