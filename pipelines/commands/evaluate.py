"""``gvtools evaluate``: every measure on finished runs, or the protocol on a project."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gvtools.errors import OptionError
from pipelines.commands.arguments import MeasurementArguments, SceneArguments
from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "measure finished runs: pictures, consistency, poses, beside published figures"
EXAMPLES = (
    "gvtools evaluate runs/kitchen --json kitchen.json",
    "gvtools evaluate scans/kitchen --protocol long --stride 3 --out runs/kitchen_long",
)


class ProtocolArguments(Arguments):
    """Of a run that is made to be measured."""

    title = "running the protocol on a project first"

    protocol: Literal["pass", "long"] | None = None
    """Pass: 2 context and 6 target views; long: three rounds of 6."""
    stride: int | None = None
    """Views from one to the next (default: widest). [N]"""
    completer: str | None = None
    """Default inpaint. [NAME]"""
    profile: str | None = None
    """Fast, balanced, accurate or finest. [NAME]"""
    set: tuple[str, ...] = ()
    """A setting. [KEY=VALUE]"""


class EvaluateArguments(MeasurementArguments, ProtocolArguments, SceneArguments):
    """The command's arguments."""

    positional = ("runs",)

    runs: tuple[Path, ...]
    """A run, several, or (--protocol) a project. [RUN]"""
    out: Path | None = None
    """Default RUN/evaluation. [DIR]"""
    against: tuple[str, ...] = ()
    """Print its published rows beside the measured one: dl3dv, realestate10k, mipnerf360,
    scannetv2, llff, ... or all; the files hold all with the paper's protocol. [BENCHMARK]"""
    data_set: str | None = None
    """That the runs are scenes of; without it nothing is ranked. [NAME]"""
    name: str = "gvtools"
    """Of the measured row. [NAME]"""
    project: Path | None = None
    """Where the run's project lies, if it was moved. [DIR]"""


def run(args: EvaluateArguments, console: Console) -> None:
    """Measure, print, write."""
    from gvtools.evaluation.published import benchmark_names
    from gvtools.files import write_json
    from pipelines.scoring.evaluation import (
        evaluate_runs,
        load_benchmarks,
        load_runs,
        write_evaluation,
    )

    shown = benchmark_names() if "all" in args.against else args.against
    benchmarks = load_benchmarks(shown, args.data_set)
    if args.project is not None and len(args.runs) > 1:
        raise OptionError("--project: names the project of one run; give one run")
    out = _folder(args)
    options = args.measures()
    paths: Sequence[Path] = args.runs
    if args.protocol is not None:
        paths = [_run_protocol(args, args.protocol, out, console=console)]
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
    if args.json_ is not None:
        write_json(args.json_, figures)


def _folder(args: EvaluateArguments) -> Path:
    if args.protocol is not None:
        if args.out is None or len(args.runs) != 1:
            raise OptionError(
                "--protocol: needs one project, and --out for the run and its figures"
            )
        return args.out
    given = [name for name in ("stride", "completer", "profile") if getattr(args, name) is not None]
    if given or args.set:
        raise OptionError(f"--{(given or ['set'])[0]}: belongs to --protocol; leave it out")
    if args.out is not None:
        return args.out
    if len(args.runs) > 1:
        raise OptionError("several runs: expected --out for their common figures")
    return args.runs[0] / "evaluation"


def _run_protocol(args: EvaluateArguments, protocol: str, out: Path, *, console: Console) -> Path:
    from pipelines.scoring.evaluation import run_protocol

    return run_protocol(
        args.open_scene(args.runs[0]),
        out,
        protocol=protocol,
        stride=args.stride,
        seed=args.seed,
        completer=args.completer,
        profile=args.profile,
        changes=args.set,
        reading=args.reading(),
        console=console,
    )
