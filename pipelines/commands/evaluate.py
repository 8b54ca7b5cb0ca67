"""``gvtools evaluate``: every measure on finished runs, or the protocol on a project."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError
from gvtools.options import check_range
from pipelines.commands.lpips_arguments import add_lpips_arguments, open_lpips
from pipelines.commands.scene_arguments import add_scene_arguments

if TYPE_CHECKING:
    from pipelines.console import Console

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
    parser.add_argument(
        "--features",
        metavar="MODULE:NAME",
        help="of feature consistency: a class of your own with name and features(rgb) (default "
        "dense-gradient)",
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
    from gvtools.runs.finished import open_run
    from pipelines.console import write_json
    from pipelines.evaluation.record import described, joined, name_apart, setting_of
    from pipelines.evaluation.run_evaluation import evaluate_run
    from pipelines.evaluation.tables import (
        comparison,
        measured_row,
        summary_table,
        view_table,
        write_tables,
    )

    parts = _parts(args.parts)
    check_range("--seed", args.seed, least=0)
    names = benchmark_names()
    shown = names if "all" in args.against else tuple(args.against)
    benchmarks = {name: load_benchmark(name) for name in dict.fromkeys((*names, *shown))}
    if args.data_set is not None:
        load_benchmark(args.data_set)
    if args.project is not None and len(args.runs) > 1:
        raise OptionError("--project: names the project of one run; give one run")
    out = _folder(args)
    lpips, no_lpips = open_lpips(args)
    network = _network(args.features)
    if args.protocol is not None:
        args.runs = [_run_protocol(args, out, console)]
    resolved = [path.resolve() for path in args.runs]
    if len(set(resolved)) < len(resolved):
        raise OptionError("a run is given twice; expected each once")
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
            network=network,
            control=not args.no_control,
            seed=args.seed,
            console=console,
        )
        evaluations.append(described(finished, found.figures))
    name_apart(evaluations)
    setting = setting_of(args, runs, evaluations, lpips is not None)
    row = measured_row(args.name, evaluations, setting)
    comparisons = {name: comparison(row, benchmark) for name, benchmark in benchmarks.items()}
    figures = joined(evaluations, row.figures, args, parts)
    over = figures["over_scenes"] if len(evaluations) > 1 else {}
    tables = {"summary": summary_table(evaluations, "Evaluation", over)}
    for number, evaluation in enumerate(evaluations):
        if "images" in evaluation:
            views = evaluation["images"]["views"]
            key = "views" if len(evaluations) == 1 else f"views_{number:03d}"
            tables[key] = view_table(views, evaluation["name"])
    tables |= {f"published_{name}": table for name, table in comparisons.items()}
    write_json(out / "evaluation.json", figures)
    write_tables(out, tables)
    if args.json is not None:
        write_json(args.json, figures)
    for table in (tables["summary"], *(comparisons[name] for name in shown)):
        _print(table, console)
    console.line(f"results in {out}: evaluation.json, and tables as .csv, .md and .tex")


def _parts(text: str) -> tuple[str, ...]:
    from pipelines.evaluation.run_evaluation import PARTS

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


def _network(spec: str | None) -> Any:
    """The feature network that the user named, or None for the default."""
    if spec is None:
        return None
    from importlib import import_module

    module, _, name = spec.partition(":")
    try:
        network = getattr(import_module(module), name)()
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise OptionError(
            f"--features {spec!r}: cannot be made ({error}); expected MODULE:NAME of a class "
            "without required arguments"
        ) from None
    if not hasattr(network, "features") or not hasattr(network, "name"):
        raise OptionError(f"--features {spec!r}: expected name and features(rgb) of it")
    return network


def _run_protocol(args: argparse.Namespace, out: Path, console: Console) -> Path:
    """Split the project, run it, and write the split beside the scores; the run's folder."""
    from gvtools.evaluation.protocol import protocol_split
    from gvtools.runs.folder import RunDirectory
    from gvtools.settings import with_profile, with_texts, with_values
    from pipelines.commands.reconstruct import reconstruct
    from pipelines.commands.scene_arguments import open_scene, reading_of
    from pipelines.console import write_json
    from pipelines.reconstruction.settings import RunSettings

    context, targets, rounds = PROTOCOLS[args.protocol]
    scene = open_scene(args.runs[0], args)
    split = protocol_split(
        scene.names, context=context, targets=targets, rounds=rounds, stride=args.stride,
        seed=args.seed,
    )  # fmt: skip
    config = RunSettings()
    if args.profile is not None:
        config = with_profile(config, args.profile)
    chosen = {
        "context": ",".join(split.context),
        "targets": ",".join(split.targets),
        "views_per_round": targets,
        "rounds": rounds,
        "seed": args.seed,
        "completer": args.completer or config.completer,
    }
    config = with_values(config, chosen)
    for text in args.set:
        key = text.partition("=")[0].strip()
        if key in chosen:
            raise OptionError(f"--set {key}: decided by --protocol; leave it out")
    config = with_texts(config, args.set)
    folder = out / "run"
    resume = (folder / "run.json").is_file()
    RunDirectory(folder).refuse_foreign()
    done = reconstruct(
        scene, config, folder, console=console, resume=resume, reading=reading_of(args)
    )
    write_json(out / "split.json", {"protocol": args.protocol, **split.to_dict()})
    return done


def _print(table: Any, console: Console) -> None:
    from gvtools.evaluation.tables import Cell

    if table.caption:
        console.line(table.caption)

    def shown(value: Any) -> Any:
        if not isinstance(value, Cell):
            return value
        if value.value is None or value.rank is None:
            return value.value
        return f"{value.value:.4g} #{value.rank}"

    rows = [[shown(value) for value in row] for row in table.rows]
    console.table([column.heading for column in table.columns], rows)
    for note in table.notes:
        console.line(f"  {note}")
