"""``gvtools evaluate``: every measure on finished runs, or the protocol on a project."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError
from pipelines.commands.arguments import (
    add_lpips_arguments,
    add_measurement_arguments,
    add_scene_arguments,
    measure_options,
)

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "measure finished runs: pictures, consistency, poses, beside published figures"
EXAMPLES = (
    "gvtools evaluate runs/kitchen --json kitchen.json",
    "gvtools evaluate scans/kitchen --protocol long --stride 3 --out runs/kitchen_long",
)
# As pipelines.scoring.evaluation has them, which is not loaded for the parser.
PROTOCOLS = ("pass", "long")


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
    add_measurement_arguments(parser)
    parser.add_argument(
        "--against",
        action="append",
        default=[],
        metavar="BENCHMARK",
        help="print its published rows beside the measured one: dl3dv, realestate10k, mipnerf360, "
        "scannetv2, llff, ... or all; the files hold all with the paper's protocol",
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
        "--protocol", choices=PROTOCOLS, help="pass: 2 context and 6 target views; long: "
        "three rounds of 6"
    )  # fmt: skip
    group.add_argument(
        "--stride", type=int, metavar="N", help="views from one to the next (default: widest)"
    )
    group.add_argument("--completer", metavar="NAME", help="default inpaint")
    group.add_argument("--profile", metavar="NAME", help="fast, balanced, accurate or finest")
    group.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting")
    add_lpips_arguments(parser)
    add_scene_arguments(parser)


def run(args: argparse.Namespace, console: Console) -> None:
    """Measure, print, write."""
    from gvtools.evaluation.published import benchmark_names
    from gvtools.files import write_json
    from pipelines.scoring.evaluation import (
        evaluate_runs,
        load_benchmarks,
        load_runs,
        write_evaluation,
    )

    shown = benchmark_names() if "all" in args.against else tuple(args.against)
    benchmarks = load_benchmarks(shown, args.data_set)
    if args.project is not None and len(args.runs) > 1:
        raise OptionError("--project: names the project of one run; give one run")
    out = _folder(args)
    options = measure_options(args)
    paths = args.runs if args.protocol is None else [_run_protocol(args, out, console)]
    runs = load_runs(paths, project=args.project)
    evaluations = evaluate_runs(runs, options, console=console)
    figures = write_evaluation(
        runs,
        evaluations,
        options,
        name=args.name,
        data_set=args.data_set,
        benchmarks=benchmarks,
        shown=shown,
        out=out,
        console=console,
    )
    if args.json is not None:
        write_json(args.json, figures)


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


def _run_protocol(args: argparse.Namespace, out: Path, console: Console) -> Path:
    from pipelines.commands.arguments import open_scene, reading_of
    from pipelines.scoring.evaluation import run_protocol

    return run_protocol(
        open_scene(args.runs[0], args),
        out,
        protocol=args.protocol,
        stride=args.stride,
        seed=args.seed,
        completer=args.completer,
        profile=args.profile,
        changes=args.set,
        reading=reading_of(args),
        console=console,
    )
